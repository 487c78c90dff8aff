// Hands without a headset: keys or a gamepad move them, one at a time. They go the way of a headset's from here on.

const [SPEED, TURNING] = [0.15, 0.6]; // of a hand [m/s], [rad/s]
const SLOWLY = 0.25; // with Shift
const LONGEST = 0.05; // of a frame that a hand moves for [s]
// A key counts for so long after it was pressed, and after each of its repeats: browsers do not always say that it is up.
// Chromium on X begins to repeat after 660 ms, and goes on every 40 ms. A page that draws slowly hears it later.
const [PRESSED, REPEATED] = [750, 600]; // [ms]
// A button that was pressed between two messages is in the next one, also if it is up again. An arm whose hand is silent
// for 150 ms stops. An older press is forgotten, because it would then engage the arm that it was to pause.
const TAPPED = 140; // [ms]
const DEAD = 0.12; // of a stick
/** @type {Record<string, Seven>} */
const START = { left: [0.3, 0.2, 1.1, 0, 0, 0, 1], right: [0.3, -0.2, 1.1, 0, 0, 0, 1] }; // x forward, y left, z up [m]
// Each moves along or turns about an axis: 0 to 2 x y z, 3 to 5 about x y z.
/** @type {Record<string, [number, number]>} */
const KEYS = {
  KeyW: [0, 1], KeyS: [0, -1], KeyA: [1, 1], KeyD: [1, -1], KeyE: [2, 1], KeyQ: [2, -1],
  KeyO: [3, 1], KeyU: [3, -1], KeyK: [4, 1], KeyI: [4, -1], KeyJ: [5, 1], KeyL: [5, -1],
};
const [LOWER, UPPER] = ["Space", "KeyG"];
/** @type {Record<string, string>} */
const HANDS = { Digit1: "left", Digit2: "right" };
const BUTTONS = [LOWER, UPPER];
const MODIFIERS = ["Control", "Meta", "Alt"];
const PAD = { a: 0, b: 1, bumpers: { left: 4, right: 5 }, tilt: [[12, 4, 1], [13, 4, -1], [14, 3, -1], [15, 3, 1]] };

/** @param {KeyboardEvent} event */
const isModified = ({ ctrlKey, metaKey, altKey, key }) => ctrlKey || metaKey || altKey || MODIFIERS.includes(key);

/**
 * A quaternion x y z w after a turn by a small rotation vector, in the room's axes.
 * @param {number[]} quaternion
 * @param {number[]} vector
 */
function turned([x, y, z, w], [a, b, c]) {
  const [p, q, r] = [a / 2, b / 2, c / 2];
  const next = [x + p * w + q * z - r * y, y + q * w + r * x - p * z, z + r * w + p * y - q * x, w - p * x - q * y - r * z];
  const length = Math.hypot(...next);
  return next.map((part) => part / length);
}

export class Flying {
  constructor() {
    this.hand = "left"; // that moves
    this.device = "keys"; // or a gamepad: what was used last
    this.slow = false;
    /** @type {Map<string, number>} */
    this.until = new Map(); // keys that are held -> when they count no more [ms]
    /** @type {Map<string, number>} */
    this.taps = new Map(); // buttons that were pressed since the last message -> when they count no more [ms]
    /** @type {Record<string, Seven>} */
    this.poses = structuredClone(START);
    this.then = performance.now();
    this.listening = new AbortController();
    const { signal } = this.listening;
    addEventListener("keydown", (event) => this.press(event), { signal });
    addEventListener("keyup", (event) => this.release(event), { signal });
    addEventListener("blur", () => this.forget(), { signal });
    /** @param {KeyboardEvent} event */
    const noticeShift = (event) => {
      this.slow = event.shiftKey;
    };
    addEventListener("keydown", noticeShift, { signal });
    addEventListener("keyup", noticeShift, { signal });
  }

  /** @param {KeyboardEvent} event */
  press(event) {
    // Such a press is the browser's: its dialogs keep the page from hearing that keys are up, and so does Cmd on a Mac.
    if (isModified(event)) return this.forget();
    if (!(event.code in KEYS || event.code in HANDS || BUTTONS.includes(event.code))) return;
    this.device = "keys";
    event.preventDefault(); // Space would press the button that began this
    if (event.repeat && !this.holds(event.code)) return; // what has ended begins with a new press only
    const until = performance.now() + (event.repeat ? REPEATED : PRESSED);
    this.until.set(event.code, until);
    if (BUTTONS.includes(event.code) && !event.repeat) this.taps.set(event.code, performance.now() + TAPPED);
    // Only the last key repeats. The others move no more then, but a dead man among them holds while any key repeats.
    for (const code of BUTTONS) if (this.holds(code)) this.until.set(code, until);
    this.choose(HANDS[event.code] ?? this.hand);
  }

  /**
   * Choose the hand that moves. A button that was pressed for one hand is not pressed for the other one.
   * @param {string} hand
   */
  choose(hand) {
    if (hand === this.hand) return;
    this.taps.clear();
    for (const code of BUTTONS) this.until.delete(code);
    this.hand = hand;
  }

  /** @param {KeyboardEvent} event */
  release(event) {
    if (isModified(event)) this.forget();
    this.until.delete(event.code);
  }

  forget() {
    this.until.clear();
    this.taps.clear();
  }


  // The hands that were read last have been sent.
  told() {
    this.taps.clear();
  }

  /** @param {string} code */
  holds(code) {
    return (this.until.get(code) ?? 0) > performance.now();
  }

  /**
   * Both hands, of which one has moved since the last frame.
   * @returns {Record<string, HeadsetHand>}
   */
  read() {
    const now = performance.now();
    const dt = Math.min((now - this.then) / 1000, LONGEST);
    this.then = now;
    const pad = [...navigator.getGamepads()].find((one) => one?.mapping === "standard");
    if (pad?.buttons.some((button) => button.pressed)) this.device = "gamepad";
    /** @param {number} button */
    const pressed = (button) => Boolean(pad?.buttons[button].pressed);
    /** @param {string} code */
    const isDown = (code) => this.holds(code) || (this.taps.get(code) ?? 0) > now;
    for (const [hand, bumper] of Object.entries(PAD.bumpers)) if (pressed(bumper)) this.choose(hand);
    const rates = [0, 0, 0, 0, 0, 0];
    for (const key in KEYS) if (this.holds(key)) rates[KEYS[key][0]] += KEYS[key][1];
    for (const [button, axis, sign] of PAD.tilt) if (pressed(button)) rates[axis] += sign;
    [1, 0, 3].forEach((stick, axis) => (rates[axis] -= this.stick(pad, stick)));
    rates[5] -= this.stick(pad, 2);
    const step = rates.map((rate, axis) => (this.slow ? SLOWLY : 1) * dt * (axis < 3 ? SPEED : TURNING) * rate);
    const pose = this.poses[this.hand];
    const place = pose.slice(0, 3).map((value, axis) => value + step[axis]);
    this.poses[this.hand] = /** @type {Seven} */ ([...place, ...turned(pose.slice(3), step.slice(3))]);
    /** @type {[boolean, boolean, boolean]} */
    const buttons = [isDown(UPPER) || pressed(PAD.b), isDown(LOWER) || pressed(PAD.a), false];
    /** @type {[boolean, boolean, boolean]} */
    const none = [false, false, false];
    return Object.fromEntries(
      Object.entries(this.poses).map(([hand, pose]) => [hand, { pose, buttons: hand === this.hand ? buttons : none }]),
    );
  }

  /**
   * @param {Gamepad | null | undefined} pad
   * @param {number} index
   */
  stick(pad, index) {
    const value = pad?.axes[index] ?? 0;
    return Math.abs(value) < DEAD ? 0 : value;
  }

  /**
   * Both hands as untracked.
   * @returns {Record<string, HeadsetHand>}
   */
  lost() {
    return { left: { pose: null }, right: { pose: null } };
  }

  end() {
    this.listening.abort();
  }
}
