// Both hands as the run wants them. In WebXR x is right, y up and z back; in the run x is forward, y left and z up.

const STRONGEST = 1000; // longest vibration; the run ends it before [ms]
const SWAPPED = 300; // another source of a hand is untracked for so long, twice the time that pauses an arm [ms]

const toRun = ({ x, y, z }) => [-z, -x, y];

export function poseOf(transform) {
  const { x, y, z, w } = transform.orientation;
  return [...toRun(transform.position), -z, -x, y, w];
}

// A transient source is there only while it pinches or touches. Such sources, and bare hands, are fingers.
const isTransient = (source) => source.targetRayMode !== "tracked-pointer";
const isBare = (source) => Boolean(source.hand) || isTransient(source);

// Whether a headset has found something else, as fingers after a controller was laid down. The pinch of fingers is not.
const isSwapped = (known, source) =>
  known !== source && !(isBare(known) && isBare(source) && (isTransient(known) || isTransient(source)));

// Sticks, triggers and buttons of the mapping "xr-standard"; pinch is the only control of bare fingers and screens.
function controlsOf(source) {
  const gamepad = source.gamepad;
  const pad = gamepad?.mapping === "xr-standard" ? gamepad : undefined;
  const pressed = (index) => Boolean(pad?.buttons[index]?.pressed);
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
    this.sources = new Map(); // hand -> its last source in this session
    this.swapped = new Map(); // hand -> until when it is untracked [ms]
    this.actuators = new Map(); // hand -> what vibrates
  }

  // The hands of a frame. One that was there and is not any more is told as untracked.
  read(frame, space, moved) {
    const hands = {};
    for (const source of frame.session.inputSources) {
      if (source.targetRayMode === "gaze") continue;
      const hand = source.handedness === "left" ? "left" : "right";
      const onScreen = source.targetRayMode === "screen"; // a touch; the phone itself is the hand
      const of = source.gripSpace ?? source.targetRaySpace;
      const pose = onScreen ? frame.getViewerPose(space) : frame.getPose(of, space);
      const untracked = this.isNew(hand, source) || !pose || pose.emulatedPosition;
      const fault = moved ? "hand_frame_moved" : untracked ? "hand_untracked" : null;
      hands[hand] = { pose: pose ? poseOf(pose.transform) : null, fault, ...controlsOf(source) };
      this.actuators.set(hand, source.gamepad?.hapticActuators?.[0] ?? source.gamepad?.vibrationActuator);
    }
    for (const hand of this.sources.keys()) hands[hand] ??= { pose: null };
    return hands;
  }

  // Whether a hand has another source than before, which ends what the last one has engaged.
  isNew(hand, source) {
    const known = this.sources.get(hand) ?? source;
    this.sources.set(hand, source);
    if (isSwapped(known, source)) this.swapped.set(hand, performance.now() + SWAPPED);
    return performance.now() < (this.swapped.get(hand) ?? 0);
  }

  // All hands as untracked: the headset's menu covers the page, or the headset is off.
  lost() {
    return Object.fromEntries([...this.sources.keys()].map((hand) => [hand, { pose: null }]));
  }

  vibrate({ hand, amplitude }) {
    this.actuators.get(hand)?.pulse?.(amplitude, amplitude > 0 ? STRONGEST : 1);
  }
}
