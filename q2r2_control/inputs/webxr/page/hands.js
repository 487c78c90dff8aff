// Both hands as the run wants them. In WebXR x is right, y up and z back; in the run x is forward, y left and z up.

const STRONGEST = 1000; // longest vibration; the run ends it before [ms]

const toRun = ({ x, y, z }) => [-z, -x, y];

export function poseOf(transform) {
  const { x, y, z, w } = transform.orientation;
  return [...toRun(transform.position), -z, -x, y, w];
}

// Sticks, triggers and buttons of the mapping "xr-standard"; pinch is the only control of bare fingers and screens.
function controlsOf(source) {
  const gamepad = source.gamepad;
  const pad = gamepad?.mapping === "xr-standard" ? gamepad : undefined;
  const pressed = (index) => Boolean(pad?.buttons[index]?.pressed);
  const value = (index) => pad?.buttons[index]?.value ?? 0;
  const bare = Boolean(source.hand) || source.targetRayMode !== "tracked-pointer";
  // A transient input is there only while it pinches or touches.
  const pinch = bare && (source.hand ? pressed(0) : true);
  const [horizontal, vertical] = [pad?.axes[2] ?? 0, pad?.axes[3] ?? 0];
  return {
    buttons: [!bare && pressed(5), !bare && pressed(4), pinch],
    axes: [horizontal, vertical === 0 ? 0 : -vertical, bare ? 0 : value(0), bare ? 0 : value(1)],
  };
}

export class Hands {
  constructor() {
    this.seen = new Set(); // hands that have been there in this session
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
      const fault = moved ? "hand_frame_moved" : !pose || pose.emulatedPosition ? "hand_untracked" : null;
      hands[hand] = { pose: pose ? poseOf(pose.transform) : null, fault, ...controlsOf(source) };
      this.seen.add(hand);
      this.actuators.set(hand, source.gamepad?.hapticActuators?.[0] ?? source.gamepad?.vibrationActuator);
    }
    for (const hand of this.seen) hands[hand] ??= { pose: null };
    return hands;
  }

  // All hands as untracked: the headset's menu covers the page, or the headset is off.
  lost() {
    return Object.fromEntries([...this.seen].map((hand) => [hand, { pose: null }]));
  }

  vibrate({ hand, amplitude }) {
    this.actuators.get(hand)?.pulse?.(amplitude, amplitude > 0 ? STRONGEST : 1);
  }
}
