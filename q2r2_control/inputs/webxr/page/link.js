// The socket to the run. Only the newest data of the hands are sent. If they would have to wait in the browser, they
// are left out instead of sent late.

const [RETRY, SELDOM] = [2000, 10000]; // time until the next attempt: during a run, and after the run is over [ms]
const ALIVE = 500; // time without a message after which a message without hands is sent [ms]
const AGAIN = 10; // time until a message that must not be left out is tried again [ms]
const REMEMBERED = 64; // number of newest messages whose times of sending are kept
const [REFUSED, OVER, FREE] = [4001, 4003, 4004]; // codes that say why the run's server has closed a socket

// The number of this page. It stays the same after a reload, so that the run recognises the page.
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
 * @property {() => void} closed called when a connection is closed, unless the page watches or may drive at once
 * @property {() => boolean} drives whether this page's operator wants to drive
 */

export class Link {
  /** @param {Handlers} handlers */
  constructor(handlers) {
    this.handlers = handlers;
    this.text = "connecting"; // the state of the connection, for people
    this.age = NaN; // time from sending a message until the run has acknowledged it [ms]; NaN if not known
    this.loss = 0; // recent share of messages that were left out
    this.over = false; // whether the run has ended
    this.watching = false; // whether this page only watches, because another page drives
    this.sequence = 0; // number of the last message
    /** @type {Map<number, number>} */
    this.sent = new Map(); // number of a message -> when it was sent [ms]
    this.last = 0; // when the last message was sent [ms]
    /** @type {number | undefined} */
    this.retry = undefined;
    this.socket = this.connect();
    addEventListener("focus", () => {
      if (this.socket.readyState !== WebSocket.CLOSED) return;
      clearTimeout(this.retry); // somebody looks at the page again, and a run may have begun
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
    // A page that was refused watches. But a page whose operator wants to drive tries again, because it may drive if
    // the other page sends no poses.
    this.watching = code === REFUSED && !this.watching && !this.handlers.drives();
    if (this.over) this.text = "The run is over. The picture is its last moment. The next run at this address shows up here.";
    else this.text = reason || "not connected; the run may have ended, or its URL is an old one";
    this.age = NaN;
    if (code !== FREE && !this.watching) this.handlers.closed();
    this.retry = setTimeout(() => this.connect(), this.watching ? 0 : this.over ? SELDOM : RETRY);
  }

  // Let this page drive, because the operator wants to. If it watches, it connects again as a page that drives.
  drive() {
    if (this.watching) this.socket.close();
  }

  /**
   * Send a message, unless earlier data still wait in the browser. Return whether it is sent.
   * @param {Record<string, HeadsetHand>} hands poses and controls of the hands
   * @param {boolean} virtual whether keys or a gamepad move the hands
   * @param {HeadsetRequest | null} request the request of a button; null if there is none
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
   * Report that hands are lost. No later message repeats this report. It is therefore never left out, but tried again
   * until it is sent.
   * @param {Record<string, HeadsetHand>} hands the lost hands, without poses
   * @param {boolean} virtual
   */
  sendLost(hands, virtual = false) {
    if (!this.send(hands, virtual)) setTimeout(() => this.sendLost(hands, virtual), AGAIN);
  }

  /**
   * Send the request of a button as soon as possible, in a message without hands.
   * @param {HeadsetRequest} request
   * @param {WebSocket} socket the connection at the time of the press; if it has been replaced, nothing is sent
   */
  ask(request, socket = this.socket) {
    if (socket !== this.socket || this.send({}, false, request)) return; // a press is for the run that was shown
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
