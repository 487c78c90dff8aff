// What the run says, as a picture for the board that an operator in VR sees.

import { nextOf, worded } from "./words.js";

export const WIDTH = 1024; // of the board's picture [pixels]
const PERIOD = 100; // between drawings [ms]
const EDGE = 24;
export const SMALLEST = 52; // letters [pixels]; capitals have CAPITAL of it
export const CAPITAL = 0.7;
const LINE = 1.22; // of a letter's size
const [DIM, BRIGHT, WARNING] = ["#9aa4ae", "#e8ecf0", "#ff7070"];

/**
 * A text's lines that fit a width.
 * @param {CanvasRenderingContext2D} context with the font of the text
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
    this.picture = null; // of a camera
    this.drawn = -PERIOD;
    this.changed = true; // since it was put on the board
  }

  /**
   * @param {ShownState | null} state
   * @param {import("./link.js").Link} link
   * @param {boolean} bare whether fingers are the hands
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
    canvas.height = Math.ceil(text + 2 * EDGE + (picture ? scale * picture.height + EDGE : 0)); // which clears it
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
   * Text, colour and size of each row.
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
