// How often this browser sends flown hands and draws the arms, and what to do if that is not often enough.

const CURE = "Make this window smaller, close other programs, or open the page on another computer.";
const LATE =
  "The hands came too late, although this browser sent them in time: the network or the run's computer is too busy. " +
  "Close other programs there, then engage again.";

const SLOW = 30; // that a picture takes; they get fewer pixels then [ms]
const LONGEST_REST = 100; // between two pictures [ms]
const KEPT = 4000; // of times that are counted [ms]
export const BLIND = 500; // a hand is not sent if no picture was drawn for so long: its operator would not see the arms [ms]

export class Pace {
  constructor() {
    /** @type {number[]} */
    this.sent = []; // when hands were sent [ms]
    /** @type {number[]} */
    this.drawn = []; // when a picture was drawn [ms]
    this.took = 0; // by the last picture, in which the page does nothing else [ms]
    this.rested = 0; // when the next picture may be drawn [ms]
    this.kept = ""; // advice while an arm is lost
    /** @type {{ now: number, silence: number }[]} */
    this.silences = []; // between two sent hands [ms]
  }

  /** @param {number} now [ms] */
  noteSent(now) {
    const last = this.sent[this.sent.length - 1];
    if (last !== undefined) this.silences.push({ now, silence: now - last });
    this.sent = [...this.sent.filter((then) => now - then < KEPT), now];
    this.silences = this.silences.filter((one) => now - one.now < KEPT);
  }

  /** @param {number} now [ms] */
  noteDrawn(now) {
    this.drawn = [...this.drawn.filter((then) => now - then < KEPT), now];
  }

  /** @param {number} now when the last picture is finished [ms] */
  noteTook(now) {
    this.took = now - (this.drawn[this.drawn.length - 1] ?? now);
    this.rested = now + Math.min(this.took, LONGEST_REST);
  }

  /**
   * Whether pictures have to wait, because keys and hands get at least as much time as pictures.
   * @param {number} now [ms]
   */
  isTired(now) {
    return now < this.rested;
  }

  // The page sends nothing on purpose, which is no fault of the browser.
  rest() {
    this.sent = [];
  }

  // The last picture has taken long.
  isSlow() {
    return this.took > SLOW;
  }

  /** @param {number} now [ms] */
  isBlind(now) {
    return now - (this.drawn[this.drawn.length - 1] ?? now) > BLIND;
  }

  /**
   * The cause and the cure of arms that stop because this browser is slow; empty if it is fast enough.
   * @param {number} now [ms]
   * @param {number} allowed the longest time without a hand [s]
   * @returns {string}
   */
  advice(now, allowed) {
    const last = this.sent[this.sent.length - 1] ?? now;
    const silence = Math.max(now - last, ...this.silences.map((one) => one.silence));
    if (!this.isBlind(now) && silence <= 1000 * allowed) return "";
    const rate = this.drawn.length < 2 ? 0 : (1000 * (this.drawn.length - 1)) / Math.max(now - this.drawn[0], 1);
    const seconds = (Math.max(silence, this.isBlind(now) ? BLIND : 0) / 1000).toFixed(2);
    return (
      `This browser is too slow: it sent no hand for ${seconds} s, and arms stop after ${allowed} s. ` +
      `It draws ${rate.toFixed(0)} pictures a second. ${CURE} Then engage again.`
    );
  }

  /**
   * The same, but as long as an arm is lost for missing hands, the advice of when it stopped stays.
   * @param {number} now [ms]
   * @param {number} allowed the longest time without a hand [s]
   * @param {boolean} silent whether an arm is lost because its hand did not come in time
   */
  keptAdvice(now, allowed, silent) {
    const advice = this.advice(now, allowed);
    this.kept = silent ? this.kept || advice || LATE : "";
    return advice || this.kept;
  }
}
