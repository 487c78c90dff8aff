// The socket to the run. The newest hands win: what would wait in the browser is left out, and never sent late.

const RETRY = 2000; // after a closed socket [ms]
const ALIVE = 500; // between messages without hands [ms]
const AGAIN = 10; // after lost hands that had to wait [ms]
const REMEMBERED = 64; // messages whose time of sending is known

// The same number after a reload, by which the run knows the page again.
function pageNumber() {
  const known = localStorage.getItem("q2r2-page");
  if (known) return known;
  const made = crypto.getRandomValues(new Uint32Array(4)).join("-");
  localStorage.setItem("q2r2-page", made);
  return made;
}

export class Link {
  constructor(handlers) {
    this.handlers = handlers; // scene, state, vibration, picture
    this.text = "connecting"; // for people
    this.age = NaN; // from a frame here to its acknowledgement [ms]
    this.loss = 0; // share of the last frames that were left out
    this.sequence = 0;
    this.sent = new Map(); // number of a message -> when it was sent [ms]
    this.last = 0; // when one was sent [ms]
    this.connect();
    setInterval(() => {
      if (performance.now() - this.last > ALIVE) this.send({});
    }, ALIVE);
  }

  get open() {
    return this.socket.readyState === WebSocket.OPEN;
  }

  connect() {
    const query = new URLSearchParams(location.search);
    query.set("page", pageNumber());
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/socket?${query}`);
    socket.binaryType = "blob";
    socket.onopen = () => (this.text = "connected");
    socket.onmessage = (event) => this.receive(event.data);
    socket.onclose = (event) => {
      this.text = event.reason || "not connected; the run may have ended, or its URL is an old one";
      this.age = NaN;
      this.handlers.closed();
      setTimeout(() => this.connect(), RETRY);
    };
    this.socket = socket;
  }

  // Send the hands, unless earlier ones still wait here, and return whether they are sent. Keys move `virtual` ones.
  send(hands, virtual = false) {
    const now = performance.now();
    const waits = !this.open || this.socket.bufferedAmount > 0;
    this.loss += 0.02 * ((waits ? 1 : 0) - this.loss);
    if (waits) return false;
    this.sequence += 1;
    this.socket.send(JSON.stringify({ seq: this.sequence, hands, virtual }));
    this.last = now;
    this.sent.set(this.sequence, now);
    this.sent.delete(this.sequence - REMEMBERED);
    return true;
  }

  // Say that hands are gone. No frame says so again, therefore this is not left out, but sent as soon as it can be.
  sendLost(hands, virtual = false) {
    if (!this.send(hands, virtual)) setTimeout(() => this.sendLost(hands, virtual), AGAIN);
  }

  receive(data) {
    if (data instanceof Blob) {
      this.handlers.picture(data);
      return;
    }
    const message = JSON.parse(data);
    if (message.scene) this.handlers.scene(message.scene);
    if (message.vibration) this.handlers.vibration(message.vibration);
    if (message.state) {
      const sent = this.sent.get(message.acknowledged);
      this.age = sent === undefined ? NaN : performance.now() - sent;
      this.handlers.state(message.state);
    }
  }
}
