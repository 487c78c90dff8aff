// Both hands as the run wants them. In WebXR x is right, y up and z back; in the run x is forward, y left and z up.

const STRONGEST = 1000; // longest vibration; the run ends it before [ms]
const SWAPPED = 300; // another source of a hand is untracked for so long, twice the time that pauses an arm [ms]

/**
 * @param {XRRigidTransform} transform
 * @returns {Seven}
 */
export function poseOf(transform) {
  const { x, y, z } = transform.position;
  const turn = transform.orientation;
  return [-z, -x, y, -turn.z, -turn.x, turn.y, turn.w];
}

// A transient source is there only while it pinches or touches. Such sources, and bare hands, are fingers.
/** @param {XRInputSource} source */
const isTransient = (source) => source.targetRayMode !== "tracked-pointer";
/** @param {XRInputSource} source */
const isBare = (source) => Boolean(source.hand) || isTransient(source);

// Whether a headset has found something else, as fingers after a controller was laid down. The pinch of fingers is not.
/**
 * @param {XRInputSource} known
 * @param {XRInputSource} source
 */
const isSwapped = (known, source) =>
  known !== source && !(isBare(known) && isBare(source) && (isTransient(known) || isTransient(source)));

// Sticks, triggers and buttons of the mapping "xr-standard"; pinch is the only control of bare fingers and screens.
/**
 * @param {XRInputSource} source
 * @returns {{ buttons: [boolean, boolean, boolean], axes: [number, number, number, number] }}
 */
function controlsOf(source) {
  const gamepad = source.gamepad;
  const pad = gamepad?.mapping === "xr-standard" ? gamepad : undefined;
  /** @param {number} index */
  const pressed = (index) => Boolean(pad?.buttons[index]?.pressed);
  /** @param {number} index */
  const value = (index) => pad?.buttons[index]?.value ?? 0;
  const bare = isBare(source);
  const pinch = bare && (source.hand ? pressed(0) : true);
  const [horizontal, vertical] = [pad?.axes[2] ?? 0, pad?.axes[3] ?? 0];
  return {
    buttons: [!bare && pressed(5), !bare && pressed(4), pinch],
    axes: [horizontal, vertical === 0 ? 0 : -vertical, bare ? 0 : value(0), bare ? 0 : value(1)],
  };
}

export class Hands {
  constructor() {
    /** @type {Map<string, XRInputSource>} */
    this.sources = new Map(); // hand -> its last source in this session
    /** @type {Map<string, number>} */
    this.swapped = new Map(); // hand -> until when it is untracked [ms]
    /** @type {Map<string, any>} */
    this.actuators = new Map(); // hand -> what vibrates
    /** @type {Float32Array[]} */
    this.places = []; // matrices of the hands of the last frame, in the room
  }

  get bare() {
    return [...this.sources.values()].some(isBare);
  }

  /**
   * The hands of a frame. One that was there and is not any more is told as untracked.
   * @param {XRFrame} frame
   * @param {XRReferenceSpace} space
   * @param {boolean} moved whether the space has moved
   */
  read(frame, space, moved) {
    /** @type {Record<string, HeadsetHand>} */
    const hands = {};
    this.places = [];
    for (const source of frame.session.inputSources) {
      if (source.targetRayMode === "gaze") continue;
      const hand = source.handedness === "left" ? "left" : "right";
      const onScreen = source.targetRayMode === "screen"; // a touch; the phone itself is the hand
      const of = source.gripSpace ?? source.targetRaySpace;
      const pose = onScreen ? frame.getViewerPose(space) : frame.getPose(of, space);
      const untracked = this.isNew(hand, source) || !pose || pose.emulatedPosition;
      const fault = moved ? "hand_frame_moved" : untracked ? "hand_untracked" : null;
      if (pose) this.places.push(pose.transform.matrix);
      hands[hand] = { pose: pose ? poseOf(pose.transform) : null, fault, ...controlsOf(source) };
      this.actuators.set(hand, actuatorOf(source.gamepad));
    }
    for (const hand of this.sources.keys()) hands[hand] ??= { pose: null };
    return hands;
  }

  /**
   * Whether a hand has another source than before, which ends what the last one has engaged.
   * @param {string} hand
   * @param {XRInputSource} source
   */
  isNew(hand, source) {
    const known = this.sources.get(hand) ?? source;
    this.sources.set(hand, source);
    if (isSwapped(known, source)) this.swapped.set(hand, performance.now() + SWAPPED);
    return performance.now() < (this.swapped.get(hand) ?? 0);
  }

  /**
   * All hands as untracked: the headset's menu covers the page, or the headset is off.
   * @returns {Record<string, HeadsetHand>}
   */
  lost() {
    return Object.fromEntries([...this.sources.keys()].map((hand) => [hand, { pose: null }]));
  }

  /** @param {ShownVibration} vibration */
  vibrate({ hand, amplitude }) {
    this.actuators.get(hand)?.pulse?.(amplitude, amplitude > 0 ? STRONGEST : 1);
  }
}

// What vibrates in a hand; browsers differ in its name.
/** @param {any} gamepad */
const actuatorOf = (gamepad) => gamepad?.hapticActuators?.[0] ?? gamepad?.vibrationActuator;
