// An emulated headset: Meta's emulator, with hands that tremble like real hands.
const device = new IWER.XRDevice(IWER.metaQuest3);
device.installRuntime({ forceInstall: true }); // replaces Chromium's own WebXR, which has no device
device.stereoEnabled = false;
device.quaternion.set(-0.25, 0, 0, 0.968); // the head looks down, at the arms
const NOISE = 2e-5; // width of the noise of each coordinate [m]
window.headset = device;
window.hands = { left: [-0.2, 1.2, -0.4], right: [0.2, 1.2, -0.4] }; // x right, y up, z back [m]
window.guessed = false; // whether poses are only guessed, as if the headset did not see the controllers; the emulator itself would say so always
Object.defineProperty(XRPose.prototype, "emulatedPosition", { get: () => window.guessed });
window.frames = 0;
window.vibrations = [];
window.said = null; // the newest state of the run

const tremble = () => {
  window.frames += 1;
  for (const [hand, place] of Object.entries(window.hands)) {
    const [x, y, z] = place.map((value) => value + NOISE * (Math.random() - 0.5));
    device.controllers[hand].position.set(x, y, z);
    device.hands[hand].position.set(x, y, z);
  }
  requestAnimationFrame(tremble);
};
requestAnimationFrame(tremble);

// Moves the hands smoothly within a number of frames. The right hand moves half as far, because two human hands never
// move as one rigid body.
window.carry = async (way, frames) => {
  const from = structuredClone(window.hands);
  for (let frame = 1; frame <= frames; frame++) {
    await new Promise(requestAnimationFrame);
    const s = frame / frames;
    const share = s ** 3 * (10 - 15 * s + 6 * s ** 2);
    window.hands.left = from.left.map((value, axis) => value + share * way[axis]);
    window.hands.right = from.right.map((value, axis) => value + 0.5 * share * way[axis]);
  }
};
window.hold = (buttons, hand, value) => {
  for (const button of buttons) device.controllers[hand].updateButtonValue(button, value);
};
window.pulses = 0; // number of vibrations that were started or ended
const actuator = Object.getPrototypeOf(device.controllers.left.inputSource.gamepad.hapticActuators[0]);
const felt = actuator.pulse;
actuator.pulse = function (...all) {
  window.pulses += 1;
  return felt.apply(this, all);
};
window.press = async (button, frames = 8) => {
  for (const value of [1, 0]) {
    for (const hand of ["left", "right"]) device.controllers[hand].updateButtonValue(button[hand], value);
    for (let frame = 0; frame < frames; frame++) await new Promise(requestAnimationFrame);
  }
};

window.full = false; // whether data wait in the socket, so that the page sends nothing
const Socket = globalThis.WebSocket;
globalThis.WebSocket = class extends Socket {
  get bufferedAmount() {
    return window.full ? 1 : super.bufferedAmount;
  }

  constructor(...all) {
    super(...all);
    this.addEventListener("message", ({ data }) => {
      if (typeof data !== "string") return;
      const message = JSON.parse(data);
      if (message.state) window.said = message.state;
      if (message.vibration) window.vibrations.push(message.vibration);
    });
  }
};
