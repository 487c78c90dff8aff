// Virtual hands without a headset. Keys or a gamepad move ("fly") one hand at a time. The run gets the same data as from
// a headset.

const [SPEED, TURNING] = [0.15, 0.6]; // linear and angular speed of a hand [m/s], [rad/s]
const SLOWLY = 0.25; // factor of both speeds while Shift is held
const LONGEST = 0.05; // a hand moves for at most this time between two readings [s]
// A key counts as held for these times after its press, and after each of its repeats, because browsers do not always
// report that a key was released. Chromium on X repeats a key after 660 ms, and then every 40 ms. A page that draws
// slowly gets these events later.
const [PRESSED, REPEATED] = [750, 600]; // [ms]
// A button that was pressed between two messages is pressed in the next message, even if it is released by then. But an
// arm whose hand sends nothing for 150 ms stops. The press is therefore forgotten before that time. Otherwise, a press
// that was to pause the arm would engage it again.
const TAPPED = 140; // [ms]
const DEAD = 0.12; // smaller displacements of a stick, which has the range -1 to 1, count as 0
/** @type {Record<string, Seven>} */
const START = { left: [0.3, 0.2, 1.1, 0, 0, 0, 1], right: [0.3, -0.2, 1.1, 0, 0, 0, 1] }; // x forward, y left, z up [m]
// By key: the index of a velocity and its sign. Indices 0 to 2 are motions along x y z, 3 to 5 are turns about x y z.
/** @type {Record<string, [number, number]>} */
const KEYS = {
  KeyW: [0, 1], KeyS: [0, -1], KeyA: [1, 1], KeyD: [1, -1], KeyE: [2, 1], KeyQ: [2, -1],
  KeyO: [3, 1], KeyU: [3, -1], KeyK: [4, 1], KeyI: [4, -1], KeyJ: [5, 1], KeyL: [5, -1],
};
const [LOWER, UPPER] = ["Space", "KeyG"];
/** @type {Record<string, string>} */
const HANDS = { Digit1: "left", Digit2: "right" };
const BUTTONS = [LOWER, UPPER]; // keys that act as the buttons of a controller
const MODIFIERS = ["Control", "Meta", "Alt"];
// Indices of the gamepad's buttons. For a button that tilts the hand: its index, the index of the velocity, the sign.
const PAD = { a: 0, b: 1, bumpers: { left: 4, right: 5 }, tilt: [[12, 4, 1], [13, 4, -1], [14, 3, -1], [15, 3, 1]] };

/** @param {KeyboardEvent} event */
const isModified = ({ ctrlKey, metaKey, altKey, key }) => ctrlKey || metaKey || altKey || MODIFIERS.includes(key);

/**
 * Turn a quaternion x y z w by a small rotation vector [rad] along the axes of the hands' frame.
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
    this.hand = "left"; // the hand that moves
    this.device = "keys"; // the device that was used last: keys or gamepad
    this.slow = false; // whether Shift is held
    /** @type {Map<string, number>} */
    this.until = new Map(); // key -> time until which it counts as held [ms]
    /** @type {Map<string, number>} */
    this.taps = new Map(); // button that was pressed since the last message -> time until which the press counts [ms]
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
    // A key with a modifier is a command to the browser. During the browser's dialogs, and while Cmd is held on a Mac,
    // the page gets no event when a key is released.
    if (isModified(event)) return this.forget();
    if (!(event.code in KEYS || event.code in HANDS || BUTTONS.includes(event.code))) return;
    this.device = "keys";
    event.preventDefault(); // otherwise Space would press the button "Fly" again
    if (event.repeat && !this.holds(event.code)) return; // a key that counts as released needs a new press
    const until = performance.now() + (event.repeat ? REPEATED : PRESSED);
    this.until.set(event.code, until);
    if (BUTTONS.includes(event.code) && !event.repeat) this.taps.set(event.code, performance.now() + TAPPED);
    // If several keys are held, only the last one repeats, and the others count as released after a while. BUTTONS are
    // an exception: they count as held as long as any key repeats, since a button may be a dead man's switch.
    for (const code of BUTTONS) if (this.holds(code)) this.until.set(code, until);
    this.choose(HANDS[event.code] ?? this.hand);
  }

  /**
   * Choose the hand that moves. Buttons that were pressed for the hand before are released.
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


  // Note that the hands of the last reading have been sent.
  told() {
    this.taps.clear();
  }

  /**
   * Return whether a key counts as held.
   * @param {string} code
   */
  holds(code) {
    return (this.until.get(code) ?? 0) > performance.now();
  }

  /**
   * Move the chosen hand by the time since the last reading, and return both hands.
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
   * Return the displacement of a stick along one axis, from -1 to 1; 0 without a gamepad.
   * @param {Gamepad | null | undefined} pad
   * @param {number} index
   */
  stick(pad, index) {
    const value = pad?.axes[index] ?? 0;
    return Math.abs(value) < DEAD ? 0 : value;
  }

  /**
   * Report both hands as untracked.
   * @returns {Record<string, HeadsetHand>}
   */
  lost() {
    return { left: { pose: null }, right: { pose: null } };
  }

  end() {
    this.listening.abort();
  }
}
