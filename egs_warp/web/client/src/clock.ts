// Playback clock of a live session. It runs slightly behind the newest frame, at the average speed of the solver, so
// that playback is smooth although frames arrive irregularly.

import type { Frame } from "./packets";

/** Number of past frames that are stored. */
const MAX_FRAMES = 900;
/** Length of the window over which the solver's speed is averaged, s. */
const AVERAGING_TIME = 4;
/** Limits of the delay behind the newest frame, s. */
const MIN_DELAY = 0.03;
const MAX_DELAY = 0.6;
/** Maximum delay behind the newest frame, s. On a machine that draws few images, playback then skips frames. */
const MAX_LAG = 2;
/** Minimum playback speed, so that the last frames of a motion are always shown. */
const MIN_SPEED = 0.02;

interface Arrival {
  wall: number;
  time: number;
}

export class LiveClock {
  /** Simulated time that is shown, s. */
  time = 0;
  /** Fractional index of the frame that is shown. */
  framePosition = 0;
  /** Simulated seconds per wall-clock second. */
  speed = 0;
  private arrivals: Arrival[] = [];
  private shownSpeed = 0;

  constructor(private readonly frames: Frame[]) {
    this.time = frames.at(-1)?.time ?? 0;
    this.updateFramePosition();
  }

  /** Record the arrival of the newest frame at wall-clock time `wall`, s. */
  addArrival(wall: number): void {
    const { frames } = this;
    const newest = frames.at(-1) as Frame;
    const before = frames.at(-2);
    const outside = this.time > newest.time || this.time < (frames[0] as Frame).time;
    if (before === undefined || outside) this.time = newest.time;
    if (newest.isReset) this.time = newest.time;
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

  /** Restart the averaging of the speed, because the solver has paused. */
  resetSpeed(): void {
    this.arrivals = [];
  }

  /** Advance by `elapsed` wall-clock seconds; return true if the displayed time has changed. */
  advance(elapsed: number): boolean {
    const newest = this.frames.at(-1);
    if (newest === undefined || this.time >= newest.time) return false;
    const lead = newest.time - this.time;
    const targetLead = this.speed * this.delay();
    // Play slower if few frames are left, but hardly faster if many are left: steps with the body in the air are fast
    // to compute, and the frames gained then cover the time of the slow steps on the ground.
    const speed =
      lead < targetLead
        ? this.speed * Math.max(lead / targetLead, 0.15)
        : this.speed * (1 + 0.3 * Math.min((lead - targetLead) / Math.max(this.speed, 1e-6), 1));
    this.shownSpeed += (speed - this.shownSpeed) * Math.min(1, 6 * elapsed);
    const earliest = newest.time - MAX_LAG * Math.max(this.speed, MIN_SPEED);
    this.time = Math.min(Math.max(this.time + elapsed * this.shownSpeed, earliest), newest.time);
    this.updateFramePosition();
    return true;
  }

  /** Time by which the picture is behind the newest frame, in wall-clock seconds. */
  get lag(): number {
    const newest = this.frames.at(-1);
    return newest === undefined ? 0 : (newest.time - this.time) / Math.max(this.speed, MIN_SPEED);
  }

  /** Return the delay behind the newest frame, s: the longest recent interval between two arrivals. */
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
    this.framePosition = b.isReset ? after : after - 1 + fraction;
  }
}
