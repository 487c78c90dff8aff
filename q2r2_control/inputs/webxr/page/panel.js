// What the run says, as a picture for a board in front of the operator.

const [WIDTH, HEIGHT] = [1024, 640];
const PERIOD = 100; // between drawings [ms]

export class Panel {
  constructor() {
    this.canvas = document.createElement("canvas");
    [this.canvas.width, this.canvas.height] = [WIDTH, HEIGHT];
    this.context = this.canvas.getContext("2d");
    this.picture = null; // of a camera
    this.drawn = -PERIOD;
    this.changed = true; // since it was put on the board
  }

  draw(state, link) {
    const now = performance.now();
    if (now - this.drawn < PERIOD) return;
    this.drawn = now;
    this.changed = true;
    const { context } = this;
    context.fillStyle = "#1c2126";
    context.fillRect(0, 0, WIDTH, HEIGHT);
    let top = 20;
    const line = (text, colour = "#e8ecf0", size = 34) => {
      context.font = `${size}px system-ui, sans-serif`;
      context.fillStyle = colour;
      context.textBaseline = "top";
      context.fillText(text, 24, top, WIDTH - 48);
      top += 1.35 * size;
    };
    const age = Number.isFinite(link.age) ? `${link.age.toFixed(0)} ms` : "no answer";
    line(link.open ? `link ${age}, ${(100 * link.loss).toFixed(0)} % left out` : link.text, "#9aa4ae", 28);
    for (const [name, arm] of Object.entries(state?.arms ?? {})) {
      line(`${name}: ${arm.state}`, `rgb(${arm.colour})`, 44);
      line(arm.why);
      line(arm.next, "#9aa4ae", 28);
    }
    if (state?.recording) line(state.recording, "#e05050");
    if (this.picture) {
      const scale = Math.min((WIDTH - 48) / this.picture.width, (HEIGHT - top - 16) / this.picture.height);
      context.drawImage(this.picture, 24, top, scale * this.picture.width, scale * this.picture.height);
    }
  }
}
