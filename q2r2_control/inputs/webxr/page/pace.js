// Measures how often this browser sends flown hands and draws the arms, and gives advice if that is not often enough.

const CURE = "Make this window smaller, close other programs, or open the page on another computer.";
const LATE =
  "The hands came too late, although this browser sent them in time: the network or the run's computer is too busy. " +
  "Close other programs there, then engage again.";

const SLOW = 30; // if a picture takes longer than this, the next pictures have fewer pixels [ms]
const LONGEST_REST = 100; // longest pause after a picture, in which keys and hands are handled [ms]
const KEPT = 4000; // times are kept for this long [ms]
// If no picture was drawn for this long, hands are not sent, because the operator could not see the arms [ms].
export const BLIND = 500;

export class Pace {
  constructor() {
    /** @type {number[]} */
    this.sent = []; // when hands were sent [ms]
    /** @type {number[]} */
    this.drawn = []; // when a picture was drawn [ms]
    this.took = 0; // time that the last picture took, in which the page does nothing else [ms]
    this.rested = 0; // when the next picture may be drawn [ms]
    this.kept = ""; // the advice from when an arm was lost, while it is lost; otherwise empty
    /** @type {{ now: number, silence: number }[]} */
    this.silences = []; // times between two sent hands, and when each of these times ended [ms]
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
   * Return whether the next picture has to wait, because keys and hands get at least as much time as pictures (up to
   * LONGEST_REST).
   * @param {number} now [ms]
   */
  isTired(now) {
    return now < this.rested;
  }

  // Forget when hands were sent, because the page now sends nothing on purpose, which is no fault of the browser.
  rest() {
    this.sent = [];
  }

  // Return whether the last picture has taken too long.
  isSlow() {
    return this.took > SLOW;
  }

  /**
   * Return whether no picture was drawn for so long that the operator cannot see the arms move.
   * @param {number} now [ms]
   */
  isBlind(now) {
    return now - (this.drawn[this.drawn.length - 1] ?? now) > BLIND;
  }

  /**
   * Return why arms stop because this browser is slow, and what to do; empty if it is fast enough.
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
   * Return the advice as above. But as long as an arm is lost because its hand did not come in time, the advice from
   * the time when it was lost stays.
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
