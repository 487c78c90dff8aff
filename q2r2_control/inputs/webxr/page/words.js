// In the texts of the run, a control is a name in braces, such as `{lower}`. The page replaces it by the word for this
// control on the operator's device.

/** @type {Record<string, string>} */
const STICKS = {
  trigger: "the trigger", grip: "the grip", stick_up: "the stick forward", stick_down: "the stick back",
  stick_left: "the stick to the left", stick_right: "the stick to the right",
};
/** @type {Record<string, Record<string, string>>} */
const WORDS = {
  left: { lower: "X", upper: "Y", ...STICKS },
  right: { lower: "A", upper: "B", ...STICKS },
  fingers: { pinch: "the pinch" },
  keys: { lower: "Space", upper: "G" },
  gamepad: { lower: "A", upper: "B" },
};

/**
 * Replace the names in braces by the words of a device.
 * @param {string} text a text from the run
 * @param {string} device the operator's device: left or right (a controller), fingers, keys, gamepad
 */
export function worded(text, device) {
  return text.replace(/\{(\w+)\}/g, (_, control) => WORDS[device]?.[control] ?? `${control} (not on this device)`);
}

/**
 * Return what an operator can do next with an arm; empty on a page that only watches.
 * @param {ShownArm} arm
 * @param {{ flying: { hand: string, device: string } | null, inSession: boolean, bare: boolean, watching: boolean }} ui
 */
export function nextOf(arm, { flying, inSession, bare, watching }) {
  if (watching) return "";
  if (flying) {
    const chosen = flying.hand === arm.hand;
    const choose = flying.device === "keys" ? `press ${arm.hand === "left" ? 1 : 2}` : `press the ${arm.hand} bumper`;
    return chosen ? worded(arm.next, flying.device) : `${choose} to move this one`;
  }
  if (inSession) return worded(arm.next, bare ? "fingers" : arm.hand);
  return "enter VR, or fly by keyboard, to move it";
}
