// Draws the texts of the run as a picture, which the board shows to an operator in VR or AR.

import { nextOf, worded } from "./words.js";

export const WIDTH = 1024; // width of the board's picture [pixels]
const PERIOD = 100; // time between two drawings [ms]
const EDGE = 24; // empty margin of the picture [pixels]
export const SMALLEST = 52; // size of the smallest letters [pixels]
export const CAPITAL = 0.7; // height of a capital letter divided by the size of the letters
const LINE = 1.22; // height of a line divided by the size of its letters
const [DIM, BRIGHT, WARNING] = ["#9aa4ae", "#e8ecf0", "#ff7070"];

/**
 * Split a text into lines that fit a width [pixels].
 * @param {CanvasRenderingContext2D} context the context, in which the font of the text is already set
 * @param {string} text
 * @param {number} width
 */
function linesOf(context, text, width) {
  /** @type {string[]} */
  const lines = [];
  for (const word of text.split(" ")) {
    const longer = lines.length ? `${lines[lines.length - 1]} ${word}` : word;
    if (lines.length && context.measureText(longer).width <= width) lines[lines.length - 1] = longer;
    else lines.push(word);
  }
  return lines;
}

export class Panel {
  constructor() {
    this.canvas = document.createElement("canvas");
    this.canvas.width = WIDTH;
    this.canvas.height = WIDTH / 2;
    this.context = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d"));
    /** @type {ImageBitmap | null} */
    this.picture = null; // the newest picture of a camera
    this.drawn = -PERIOD; // when the panel was drawn last [ms]
    this.changed = true; // whether the panel was drawn again since its picture was put on the board
  }

  /**
   * @param {ShownState | null} state
   * @param {import("./link.js").Link} link
   * @param {boolean} bare whether the operator uses bare fingers
   */
  draw(state, link, bare) {
    const now = performance.now();
    if (now - this.drawn < PERIOD) return;
    this.drawn = now;
    this.changed = true;
    const { context, canvas, picture } = this;
    const rows = this.rows(state, link, bare).flatMap(([text, colour, size]) => {
      context.font = fontOf(size);
      return linesOf(context, text, WIDTH - 2 * EDGE).map((line) => ({ line, colour, size }));
    });
    const text = rows.reduce((sum, { size }) => sum + LINE * size, 0);
    const scale = picture ? Math.min(1, 600 / picture.height) * Math.min(1, (WIDTH - 2 * EDGE) / picture.width) : 0;
    canvas.height = Math.ceil(text + 2 * EDGE + (picture ? scale * picture.height + EDGE : 0)); // this clears it too
    context.fillStyle = "#1c2126";
    context.fillRect(0, 0, WIDTH, canvas.height);
    context.textBaseline = "top";
    let top = EDGE;
    for (const { line, colour, size } of rows) {
      context.font = fontOf(size);
      context.fillStyle = colour;
      context.fillText(line, EDGE, top, WIDTH - 2 * EDGE);
      top += LINE * size;
    }
    if (picture) context.drawImage(picture, EDGE, top + EDGE / 2, scale * picture.width, scale * picture.height);
  }

  /**
   * Return the text, the colour and the size of the letters [pixels] of each row.
   * @param {ShownState | null} state
   * @param {import("./link.js").Link} link
   * @param {boolean} bare
   * @returns {[string, string, number][]}
   */
  rows(state, link, bare) {
    /** @type {[string, string, number][]} */
    const rows = [];
    if (!link.open) rows.push([link.text, WARNING, SMALLEST]);
    const way = { flying: null, inSession: true, bare, watching: false };
    for (const [name, arm] of Object.entries(state?.arms ?? {})) {
      rows.push([`${name}: ${arm.state}`, `rgb(${arm.colour})`, 60]);
      rows.push([worded(arm.why, bare ? "fingers" : arm.hand), BRIGHT, SMALLEST]);
      rows.push([nextOf(arm, way), DIM, SMALLEST]);
    }
    if (state?.pair) rows.push([`tightest pair: ${(1000 * state.pair.margin).toFixed(0)} mm to spare`, DIM, SMALLEST]);
    if (state?.recording) rows.push([state.recording, WARNING, SMALLEST]);
    return rows;
  }
}

/** @param {number} size */
const fontOf = (size) => `${size}px system-ui, sans-serif`;
