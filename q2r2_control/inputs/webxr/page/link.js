// The socket to the run. The newest hands win: what would wait in the browser is left out, and never sent late.

const [RETRY, SELDOM] = [2000, 10000]; // after a closed socket, and after the end of a run [ms]
const ALIVE = 500; // between messages without hands [ms]
const AGAIN = 10; // after what must not be left out had to wait [ms]
const REMEMBERED = 64; // messages whose time of sending is known
const [REFUSED, OVER, FREE] = [4001, 4003, 4004]; // why the run's server has closed a socket

// The same number after a reload, by which the run knows the page again.
function pageNumber() {
  const known = localStorage.getItem("q2r2-page");
  if (known) return known;
  const made = crypto.getRandomValues(new Uint32Array(4)).join("-");
  localStorage.setItem("q2r2-page", made);
  return made;
}

/**
 * @typedef {object} Handlers
 * @property {(scene: ShownScene) => void} scene
 * @property {(state: ShownState) => void} state
 * @property {(vibration: ShownVibration) => void} vibration
 * @property {(jpeg: Blob) => void} picture
 * @property {() => void} closed
 * @property {() => boolean} drives whether somebody here wants to drive
 */

export class Link {
  /** @param {Handlers} handlers */
  constructor(handlers) {
    this.handlers = handlers;
    this.text = "connecting"; // for people
    this.age = NaN; // from a frame here to its acknowledgement [ms]
    this.loss = 0; // share of the last frames that were left out
    this.over = false; // the run has ended
    this.watching = false; // another page drives
    this.sequence = 0;
    /** @type {Map<number, number>} */
    this.sent = new Map(); // number of a message -> when it was sent [ms]
    this.last = 0; // when one was sent [ms]
    /** @type {number | undefined} */
    this.retry = undefined;
    this.socket = this.connect();
    addEventListener("focus", () => {
      if (this.socket.readyState !== WebSocket.CLOSED) return;
      clearTimeout(this.retry); // somebody looks: a run may have begun
      this.connect();
    });
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
    if (this.watching) query.set("watch", "1");
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/socket?${query}`);
    socket.binaryType = "blob";
    socket.onopen = () => {
      this.over = false;
      if (!this.watching) this.text = "connected";
    };
    socket.onmessage = (event) => this.receive(event.data);
    socket.onclose = ({ code, reason }) => this.close(code, reason);
    this.socket = socket;
    return socket;
  }

  /**
   * @param {number} code
   * @param {string} reason
   */
  close(code, reason) {
    this.over ||= code === OVER;
    // A page that may not drive looks on. One with hands tries again: its poses may count more than another page.
    this.watching = code === REFUSED && !this.watching && !this.handlers.drives();
    if (this.over) this.text = "The run is over. The picture is its last moment. The next run at this address shows up here.";
    else this.text = reason || "not connected; the run may have ended, or its URL is an old one";
    this.age = NaN;
    if (code !== FREE && !this.watching) this.handlers.closed();
    this.retry = setTimeout(() => this.connect(), this.watching ? 0 : this.over ? SELDOM : RETRY);
  }

  // Somebody here wants to drive, which a page that watches cannot.
  drive() {
    if (this.watching) this.socket.close();
  }

  /**
   * Send the hands, unless earlier ones still wait here, and return whether they are sent. Keys move `virtual` ones.
   * @param {Record<string, HeadsetHand>} hands
   * @param {boolean} virtual
   * @param {HeadsetRequest | null} request of a button
   */
  send(hands, virtual = false, request = null) {
    const now = performance.now();
    const waits = !this.open || this.socket.bufferedAmount > 0;
    this.loss += 0.02 * ((waits ? 1 : 0) - this.loss);
    if (waits) return false;
    this.sequence += 1;
    /** @type {PageMessage} */
    const message = { seq: this.sequence, hands, virtual };
    if (request !== null) message.request = request;
    this.socket.send(JSON.stringify(message));
    this.last = now;
    this.sent.set(this.sequence, now);
    this.sent.delete(this.sequence - REMEMBERED);
    return true;
  }

  /**
   * Say that hands are gone. No frame says so again, therefore this is not left out, but sent as soon as it can be.
   * @param {Record<string, HeadsetHand>} hands
   * @param {boolean} virtual
   */
  sendLost(hands, virtual = false) {
    if (!this.send(hands, virtual)) setTimeout(() => this.sendLost(hands, virtual), AGAIN);
  }

  /**
   * Ask for what a button does, as soon as it can be sent on this connection. It says nothing of the hands.
   * @param {HeadsetRequest} request
   * @param {WebSocket} socket
   */
  ask(request, socket = this.socket) {
    if (socket !== this.socket || this.send({}, false, request)) return; // a press is for the run that was seen
    setTimeout(() => this.ask(request, socket), AGAIN);
  }

  /** @param {string | Blob} data */
  receive(data) {
    if (data instanceof Blob) {
      this.handlers.picture(data);
      return;
    }
    /** @type {FromRun} */
    const message = JSON.parse(data);
    if (message.scene) this.handlers.scene(message.scene);
    if (message.vibration) this.handlers.vibration(message.vibration);
    if (message.driver) this.text = `${message.driver} drives; this page watches, and can only stop the run`;
    if (message.state) {
      const sent = this.sent.get(message.acknowledged ?? -1);
      this.age = sent === undefined ? NaN : performance.now() - sent;
      this.handlers.state(message.state);
    }
  }
}
