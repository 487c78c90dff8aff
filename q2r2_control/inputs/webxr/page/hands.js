// Reads both hands from WebXR, in the form that the run expects.
// In WebXR x points right, y up and z back. In the run x points forward, y left and z up.

const STRONGEST = 1000; // duration with which a vibration is started; the run ends it earlier, by amplitude 0 [ms]
// A hand that gets another input source counts as untracked for this time, which is twice the time after which an arm
// pauses [ms].
const SWAPPED = 300;

/**
 * Return a pose in the axes of the run.
 * @param {XRRigidTransform} transform the pose in the axes of WebXR
 * @returns {Seven}
 */
export function poseOf(transform) {
  const { x, y, z } = transform.position;
  const turn = transform.orientation;
  return [-z, -x, y, -turn.z, -turn.x, turn.y, turn.w];
}

// A transient source exists only while fingers pinch or touch a screen. Transient sources and tracked hands are "bare".
/** @param {XRInputSource} source */
const isTransient = (source) => source.targetRayMode !== "tracked-pointer";
/** @param {XRInputSource} source */
const isBare = (source) => Boolean(source.hand) || isTransient(source);

// Whether a hand has got another device, such as bare fingers after its controller was laid down. If tracked fingers
// begin or end a pinch, their source changes too, but this does not count.
/**
 * @param {XRInputSource} known
 * @param {XRInputSource} source
 */
const isSwapped = (known, source) =>
  known !== source && !(isBare(known) && isBare(source) && (isTransient(known) || isTransient(source)));

// Reads sticks, triggers and buttons by the mapping "xr-standard". Bare fingers and screens have only the pinch.
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
    this.swapped = new Map(); // hand -> time until which it counts as untracked [ms]
    /** @type {Map<string, any>} */
    this.actuators = new Map(); // hand -> the actuator that vibrates; undefined if there is none
    /** @type {Float32Array[]} */
    this.places = []; // poses of the hands in the last frame, as matrices in the operator's room
  }

  get bare() {
    return [...this.sources.values()].some(isBare);
  }

  /**
   * Read the hands of a frame. A hand that was in an earlier frame and is missing now is reported as untracked.
   * @param {XRFrame} frame
   * @param {XRReferenceSpace} space
   * @param {boolean} moved whether the reference space has moved just now
   */
  read(frame, space, moved) {
    /** @type {Record<string, HeadsetHand>} */
    const hands = {};
    this.places = [];
    for (const source of frame.session.inputSources) {
      if (source.targetRayMode === "gaze") continue;
      const hand = source.handedness === "left" ? "left" : "right";
      const onScreen = source.targetRayMode === "screen"; // a touch: the pose of the phone is the hand's pose
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
   * Return whether a hand has got another device in the last SWAPPED ms. Its arm must then be engaged again.
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
   * Report all hands as untracked, because the headset's menu covers the page, or the headset was taken off.
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

// The actuator that lets a hand's controller vibrate. Browsers use different names for it.
/** @param {any} gamepad */
const actuatorOf = (gamepad) => gamepad?.hapticActuators?.[0] ?? gamepad?.vibrationActuator;
