// The page: enters VR or AR, sends the hands once a frame, shows what the run says.

import { Drawing, eyesOf } from "./draw.js";
import { Flying, HELP } from "./fly.js";
import { Hands } from "./hands.js";
import { Link } from "./link.js";
import { Panel } from "./panel.js";

const MOVED = 300; // a frame that moved is told for this long, twice the time that pauses an arm [ms]
const MODES = ["immersive-ar", "immersive-vr"];

const element = (id) => document.getElementById(id);
const drawing = new Drawing(element("scene"));
const panel = new Panel();
let hands = new Hands();
let session = null;
let flying = null; // hands that keys or a gamepad move
let state = null; // of the run, as it came last
let movedUntil = 0;

const link = new Link({
  scene: (scene) => drawing.setScene(scene),
  state: (newest) => (state = newest),
  vibration: (vibration) => hands.vibrate(vibration),
  picture: async (jpeg) => {
    const picture = await createImageBitmap(jpeg);
    panel.picture?.close();
    panel.picture = picture;
  },
  closed: () => (state = null),
});

// Where the operator stands and looks when the session begins: origin and forward of the hands.
function facing(frame, floor) {
  const pose = frame.getViewerPose(floor);
  if (!pose) return null;
  const [m, { x, z }] = [pose.transform.matrix, pose.transform.position];
  const turn = Math.atan2(m[8], m[10]) / 2; // of the way that the operator looks, about y
  const orientation = { x: 0, y: Math.sin(turn), z: 0, w: Math.cos(turn) };
  return floor.getOffsetReferenceSpace(new XRRigidTransform({ x, y: 0, z }, orientation));
}

async function enter(mode) {
  land();
  const entered = await navigator.xr.requestSession(mode, {
    requiredFeatures: ["local-floor"],
    optionalFeatures: ["hand-tracking"],
  });
  session = entered;
  hands = new Hands();
  await drawing.bind(entered);
  const floor = await entered.requestReferenceSpace("local-floor");
  let space = null;
  floor.onreset = () => {
    movedUntil = performance.now() + MOVED;
    space = null;
  };
  entered.onvisibilitychange = () => {
    if (entered.visibilityState !== "visible") link.sendLost(hands.lost());
  };
  entered.onend = () => {
    link.sendLost(hands.lost());
    session = null;
    show();
  };
  const onFrame = (now, frame) => {
    entered.requestAnimationFrame(onFrame);
    space ??= facing(frame, floor);
    if (space === null || entered.visibilityState !== "visible") return;
    link.send(hands.read(frame, space, performance.now() < movedUntil));
    panel.draw(state, link);
    drawing.draw(entered.renderState.baseLayer.framebuffer, eyesOf(frame, space), state, panel, mode === "immersive-ar");
  };
  entered.requestAnimationFrame(onFrame);
  show();
}

function fly() {
  if (flying) return land();
  const begun = (flying = new Flying());
  element("fly").blur();
  element("advice").textContent = HELP;
  document.body.classList.add("flying"); // which leaves the arms to be seen
  const onFrame = () => {
    if (flying !== begun) return;
    requestAnimationFrame(onFrame);
    link.send(begun.read(), true);
    panel.draw(state, link);
    drawing.drawOnPage(state, panel);
  };
  requestAnimationFrame(onFrame);
}

// No hand is flown any more, which stops the arms.
function land() {
  if (!flying) return;
  link.sendLost(flying.lost(), true);
  flying.end();
  flying = null;
  document.body.classList.remove("flying");
  element("advice").textContent = "";
}

function show() {
  const age = Number.isFinite(link.age) ? `, ${link.age.toFixed(0)} ms` : "";
  element("link").textContent = `${link.text}${age}, ${(100 * link.loss).toFixed(0)} % left out`;
  element("leave").hidden = session === null;
  element("fly").hidden = session !== null;
  element("stand").hidden = flying !== null;
  element("fly").textContent = flying ? `Land; the ${flying.hand} hand moves` : "Fly by keyboard or gamepad";
  const rows = Object.entries(state?.arms ?? {}).map(([name, arm]) => {
    const row = document.createElement("tr");
    for (const text of [name, arm.state, arm.why, arm.next]) row.insertCell().textContent = text;
    return row;
  });
  element("arms").replaceChildren(...rows);
  element("recording").textContent = state?.recording ?? "";
}

async function offer() {
  if (!navigator.xr) {
    element("advice").textContent = isSecureContext
      ? "This browser has no WebXR."
      : "A browser offers WebXR only over https, or on localhost.";
    return;
  }
  const supported = await Promise.all(MODES.map((mode) => navigator.xr.isSessionSupported(mode).catch(() => false)));
  MODES.forEach((mode, index) => {
    const button = element(mode);
    button.hidden = !supported[index];
    button.onclick = () => enter(mode).catch((error) => (element("advice").textContent = String(error)));
  });
  if (!supported.includes(true)) element("advice").textContent = "This device offers no immersive session.";
}

element("leave").onclick = () => session?.end();
element("fly").onclick = fly;
document.addEventListener("visibilitychange", () => document.hidden && land());
setInterval(show, 200);
offer();
