// Shows a session evenly, however unevenly its frames come: a little behind the newest, as slow as the solver is.

import type { Frame } from "./packets";

/** Frames that are kept to look back at. */
const MAX_FRAMES = 900;
/** Seconds over which the solver's speed is averaged. */
const AVERAGING_TIME = 4;
/** Seconds behind the newest frame: at least and at most. */
const MIN_DELAY = 0.03;
const MAX_DELAY = 0.6;
/** The last of a motion is shown, however slowly it came. */
const MIN_SPEED = 0.02;

interface Arrival {
  wall: number;
  time: number;
}

export class LiveClock {
  /** Of the moment shown, seconds of the creature's time. */
  time = 0;
  /** Frames, with a fraction between two of them. */
  framePosition = 0;
  /** Seconds of the creature's time that the solver makes in one of ours. */
  speed = 0;
  private arrivals: Arrival[] = [];
  private shownSpeed = 0;

  constructor(private readonly frames: Frame[]) {
    this.time = frames.at(-1)?.time ?? 0;
    this.updateFramePosition();
  }

  /** Told of the newest frame; `wall` in seconds. */
  addArrival(wall: number): void {
    const { frames } = this;
    const newest = frames.at(-1) as Frame;
    const before = frames.at(-2);
    const outside = this.time > newest.time || this.time < (frames[0] as Frame).time;
    if (before === undefined || outside) this.time = newest.time;
    if (before !== undefined && isDiscontinuous(before, newest)) this.time = newest.time;
    const last = this.arrivals.at(-1);
    if (last !== undefined && wall - last.wall > 2) this.resetSpeed();
    this.arrivals.push({ wall, time: newest.time });
    while (this.arrivals.length > 2 && wall - this.arrivals[0]!.wall > AVERAGING_TIME) this.arrivals.shift();
    const first = this.arrivals[0]!;
    if (wall - first.wall > 0.2) {
      this.speed = Math.min(Math.max((newest.time - first.time) / (wall - first.wall), MIN_SPEED), 1.05);
    }
    else if (this.speed === 0 && before !== undefined) this.speed = 0.2;
    if (frames.length > MAX_FRAMES + 60) frames.splice(0, frames.length - MAX_FRAMES);
    this.updateFramePosition();
  }

  /** The solver pauses: what comes after is not to be averaged with what was before. */
  resetSpeed(): void {
    this.arrivals = [];
  }

  /** After `elapsed` seconds; true where the picture is another one. */
  advance(elapsed: number): boolean {
    const newest = this.frames.at(-1);
    if (newest === undefined || this.time >= newest.time) return false;
    const lead = newest.time - this.time;
    const targetLead = this.speed * this.delay();
    // Slower with little ahead; with much hardly faster: in the air steps are quick, and what they gain bridges the
    // slow ones on the ground.
    const speed =
      lead < targetLead
        ? this.speed * Math.max(lead / targetLead, 0.15)
        : this.speed * (1 + 0.3 * Math.min((lead - targetLead) / Math.max(this.speed, 1e-6), 1));
    this.shownSpeed += (speed - this.shownSpeed) * Math.min(1, 6 * elapsed);
    this.time = Math.min(this.time + Math.min(elapsed, 0.25) * this.shownSpeed, newest.time);
    this.updateFramePosition();
    return true;
  }

  /** Seconds of ours that the picture is behind the newest frame: the longest pause between two, of late. */
  private delay(): number {
    let longest = 0;
    for (let k = Math.max(1, this.arrivals.length - 12); k < this.arrivals.length; k++) {
      longest = Math.max(longest, this.arrivals[k]!.wall - this.arrivals[k - 1]!.wall);
    }
    return Math.min(Math.max(1.1 * longest, MIN_DELAY), MAX_DELAY);
  }

  private updateFramePosition(): void {
    const { frames } = this;
    let after = frames.length - 1;
    while (after > 0 && (frames[after - 1] as Frame).time >= this.time) after--;
    if (after <= 0) {
      this.framePosition = 0;
      return;
    }
    const [a, b] = [frames[after - 1] as Frame, frames[after] as Frame];
    const fraction = Math.min((this.time - a.time) / Math.max(b.time - a.time, 1e-9), 1);
    this.framePosition = isDiscontinuous(a, b) ? after : after - 1 + fraction;
  }
}

/** Whether the creature was put elsewhere between two frames: nothing moves so far in a step. */
function isDiscontinuous(before: Frame, after: Frame): boolean {
  const [a, b] = [before.positions, after.positions];
  let low = Infinity;
  let high = -Infinity;
  for (let k = 2; k < a.length; k += 3) {
    low = Math.min(low, a[k]!);
    high = Math.max(high, a[k]!);
  }
  return Math.hypot(b[0]! - a[0]!, b[1]! - a[1]!, b[2]! - a[2]!) > 0.5 * Math.max(high - low, 1e-9);
}
