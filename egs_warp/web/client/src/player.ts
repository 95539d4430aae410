// Where in the run we are, and how it goes on.

import type { FrameSource } from "./source";

export class Player {
  playing = false;
  loop = true;
  speed = 1;
  /** Frames, with a fraction between two of them. */
  place = 0;

  constructor(
    private readonly sources: FrameSource[],
    private readonly changed: () => void,
  ) {}

  /** The longest of the runs side by side; a shorter one waits at its end. */
  get last(): number {
    return Math.max(...this.sources.map((source) => source.frames.length)) - 1;
  }

  get rate(): number {
    return (this.sources[0] as FrameSource).header.facts.rate;
  }

  get seconds(): number {
    return this.place / this.rate;
  }

  toggle(): void {
    this.playing = !this.playing;
    if (this.playing && this.place >= this.last) this.place = 0;
    this.changed();
  }

  seek(place: number): void {
    this.place = Math.min(Math.max(place, 0), this.last);
    this.changed();
  }

  /** One frame on or back. */
  step(frames: number): void {
    this.playing = false;
    this.seek(Math.round(this.place) + frames);
  }

  /** After `elapsed` seconds. */
  advance(elapsed: number): void {
    if (!this.playing) return;
    // A tab that slept goes on where it was.
    this.place += Math.min(elapsed, 0.25) * this.rate * this.speed;
    if (this.place >= this.last) {
      if (this.loop && this.last > 0) this.place %= this.last;
      else {
        this.place = this.last;
        this.playing = false;
      }
    }
    this.changed();
  }
}
