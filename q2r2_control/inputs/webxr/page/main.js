// The page: enters VR or AR or lets keys or a gamepad move ("fly") a hand, sends the hands, and shows the run's state.

import { Drawing, eyesOf } from "./draw.js";
import { Flying } from "./fly.js";
import { Hands } from "./hands.js";
import { Link } from "./link.js";
import { Pace } from "./pace.js";
import { Panel } from "./panel.js";
import { nextOf, worded } from "./words.js";

const SENDING = 16; // time between two messages about flown hands, however slowly the page draws [ms]
// Time for which a move of the reference space is reported. It is twice the time after which an arm pauses [ms].
const MOVED = 300;
/** @type {XRSessionMode[]} */
const MODES = ["immersive-ar", "immersive-vr"];

/** @param {string} id */
const element = (id) => /** @type {HTMLElement} */ (document.getElementById(id));
/** @param {string} id */
const button = (id) => /** @type {HTMLButtonElement} */ (document.getElementById(id));
const drawing = new Drawing(/** @type {HTMLCanvasElement} */ (document.getElementById("scene")));
const panel = new Panel();
let hands = new Hands();
/** @type {XRSession | null} */
let session = null;
/** @type {Flying | null} */
let flying = null; // hands that keys or a gamepad move
let pace = new Pace(); // times of the pictures and messages while hands are flown
/** @type {ShownState | null} */
let state = null; // newest state of the run
let movedUntil = 0; // until this time, the hands' frame is reported as moved [ms]

const link = new Link({
  scene: (scene) => {
    drawing.setScene(scene);
    element("name").textContent = scene.name;
    document.title = `${scene.name}: drive the arms`;
  },
  state: (newest) => {
    state = newest;
  },
  vibration: (vibration) => hands.vibrate(vibration),
  picture: async (jpeg) => {
    const picture = await createImageBitmap(jpeg);
    panel.picture?.close();
    panel.picture = picture;
  },
  closed: () => {
    if (link.over) land(); // the last picture remains visible
    else state = null;
  },
  drives: () => session !== null || flying !== null,
});

/**
 * Return the reference space of the hands. Its origin is on the floor below the operator's head, and its forward axis
 * is the direction in which the operator looks now. The result is null if the head is not tracked.
 * @param {XRFrame} frame
 * @param {XRReferenceSpace} floor
 */
function facing(frame, floor) {
  const pose = frame.getViewerPose(floor);
  if (!pose) return null;
  const m = pose.transform.matrix;
  const { x, z } = pose.transform.position;
  const turn = Math.atan2(m[8], m[10]) / 2; // half the angle about y from forward to the operator's direction [rad]
  const orientation = { x: 0, y: Math.sin(turn), z: 0, w: Math.cos(turn) };
  return floor.getOffsetReferenceSpace(new XRRigidTransform({ x, y: 0, z }, orientation));
}

/** @param {XRSessionMode} mode */
async function enter(mode) {
  land();
  const xr = /** @type {XRSystem} */ (navigator.xr);
  const entered = await xr.requestSession(mode, {
    requiredFeatures: ["local-floor"],
    optionalFeatures: ["hand-tracking"],
  });
  session = entered;
  link.drive();
  hands = new Hands();
  await drawing.bind(entered);
  const floor = await entered.requestReferenceSpace("local-floor");
  /** @type {XRReferenceSpace | null} */
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
  /** @type {XRFrameRequestCallback} */
  const onFrame = (_, frame) => {
    entered.requestAnimationFrame(onFrame);
    space ??= facing(frame, floor);
    if (space === null || entered.visibilityState !== "visible") return;
    link.send(hands.read(frame, space, performance.now() < movedUntil));
    panel.draw(state, link, hands.bare);
    const layer = /** @type {XRWebGLLayer} */ (entered.renderState.baseLayer);
    drawing.lookFrom(frame.getViewerPose(space)?.transform.matrix);
    drawing.draw(layer.framebuffer, eyesOf(frame, space), state, panel, hands.places, mode === "immersive-ar");
  };
  entered.requestAnimationFrame(onFrame);
  show();
}

function fly() {
  if (flying) {
    land();
    return;
  }
  const begun = new Flying();
  flying = begun;
  const kept = new Pace();
  pace = kept;
  link.drive();
  element("fly").blur();
  const onFrame = () => {
    if (flying !== begun) return;
    requestAnimationFrame(onFrame);
    const now = performance.now();
    if (kept.isTired(now) || !drawing.drawOnPage(state)) return;
    kept.noteDrawn(now);
    // The browser finishes the picture before it runs this task. If a processor draws the picture, it does nothing else
    // meanwhile.
    setTimeout(() => {
      kept.noteTook(performance.now());
      if (kept.isSlow()) drawing.coarsen();
    });
  };
  requestAnimationFrame(onFrame);
  // A page that draws slowly sends as often as any other page. A page that is hidden, has no focus, or has drawn no
  // picture for a while sends nothing, so that its arms stop.
  const sending = setInterval(() => {
    if (flying !== begun) {
      clearInterval(sending);
      return;
    }
    const now = performance.now();
    if (document.hidden || !document.hasFocus()) kept.rest();
    else if (!kept.isBlind(now) && link.send(begun.read(), true)) {
      begun.told();
      kept.noteSent(now);
    }
  }, SENDING);
  show();
}

// End flying. The run then stops the arms.
function land() {
  if (!flying) return;
  link.sendLost(flying.lost(), true);
  flying.end();
  flying = null;
}

/**
 * Return a row of the table: an arm's state in its colour, the reason for the state, and what its operator can do next.
 * @param {string} name
 * @param {ShownArm} arm
 */
function rowOf(name, arm) {
  const row = document.createElement("tr");
  row.insertCell().textContent = name;
  const words = row.insertCell();
  const said = document.createElement("span");
  said.className = "state";
  said.style.background = `rgb(${arm.colour})`;
  said.textContent = arm.state;
  const next = document.createElement("div");
  next.className = "next";
  next.textContent = nextOf(arm, { flying, inSession: session !== null, bare: hands.bare, watching: link.watching });
  const why = /^\{\w+\}$/.test(arm.why) ? `by ${arm.why}` : arm.why; // a control that was pressed
  words.append(said, why === arm.state ? "" : ` ${worded(why, flying?.device ?? (hands.bare ? "fingers" : arm.hand))}`, next);
  return row;
}

// Return why keys or a gamepad move nothing, although they fly a hand; empty if there is no such reason.
function slowness() {
  if (!document.hasFocus()) return "Keys do not reach this page: click on it, then engage again.";
  if (!link.open || !drawing.scene) return "";
  const silent = Object.values(state?.arms ?? {}).some((arm) => arm.silent);
  return pace.keptAdvice(performance.now(), drawing.scene.timeout, silent);
}

function show() {
  const age = Number.isFinite(link.age) ? `, ${link.age.toFixed(0)} ms` : "";
  const lost = link.open && !link.watching ? `${age}, ${(100 * link.loss).toFixed(0)} % left out` : "";
  element("link").textContent = `${link.text}${lost}`;
  element("slow").textContent = flying ? slowness() : "";
  element("leave").hidden = session === null;
  element("fly").hidden = session !== null;
  element("stand").hidden = flying !== null || link.watching;
  element("fly").textContent = flying ? "Stop keyboard and gamepad" : link.watching ? "Fly, when the other page rests" : "Fly by keyboard or gamepad";
  element("flown").textContent = flying ? `The ${flying.hand} hand moves.` : "";
  element("keys").hidden = flying === null;
  button("stop").disabled = !link.open;
  button("home").disabled = button("pause").disabled = !link.open;
  element("home").hidden = element("pause").hidden = link.watching;
  button("fly").disabled = flying === null && !link.open;
  element("arms").replaceChildren(...Object.entries((!link.over && state?.arms) || {}).map(([name, arm]) => rowOf(name, arm)));
  element("recording").textContent = (!link.over && state?.recording) || "";
  if (session === null && flying === null) drawing.drawOnPage(state);
}

async function offer() {
  const { xr } = navigator;
  if (!xr) {
    element("advice").textContent = isSecureContext
      ? "This browser has no WebXR."
      : "A browser offers WebXR only over https, or on localhost.";
    return;
  }
  const supported = await Promise.all(MODES.map((mode) => xr.isSessionSupported(mode).catch(() => false)));
  MODES.forEach((mode, index) => {
    button(mode).hidden = !supported[index];
    button(mode).onclick = () =>
      enter(mode).catch((error) => {
        element("advice").textContent = String(error);
      });
  });
  if (!supported.includes(true)) element("advice").textContent = "This device shows no VR or AR.";
}

button("leave").onclick = () => session?.end();
button("fly").onclick = fly;
/** @type {HeadsetRequest[]} */ (["stop", "pause", "home"]).forEach((request) => {
  button(request).onclick = () => {
    button(request).blur(); // otherwise Space, which engages an arm, would press this button again
    link.ask(request);
  };
});
document.addEventListener("visibilitychange", () => {
  if (document.hidden) land();
});
addEventListener("blur", () => {
  if (flying) link.sendLost(flying.lost(), true);
});
setInterval(show, 200);
offer();
