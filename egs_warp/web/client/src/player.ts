// Where in the run we are, and how it goes on.

import type { FrameSource } from "./frame_source";

export class Player {
  playing = false;
  loop = true;
  speed = 1;
  /** Frames, with a fraction between two of them. */
  framePosition = 0;

  constructor(
    private readonly sources: FrameSource[],
    private readonly onChange: () => void,
  ) {}

  /** The longest of the runs side by side; a shorter one waits at its end. */
  get lastFrame(): number {
    return Math.max(...this.sources.map((source) => source.frames.length)) - 1;
  }

  get rate(): number {
    return (this.sources[0] as FrameSource).header.facts.rate;
  }

  get seconds(): number {
    return this.framePosition / this.rate;
  }

  toggle(): void {
    this.playing = !this.playing;
    if (this.playing && this.framePosition >= this.lastFrame) this.framePosition = 0;
    this.onChange();
  }

  seek(framePosition: number): void {
    this.framePosition = Math.min(Math.max(framePosition, 0), this.lastFrame);
    this.onChange();
  }

  /** One frame on or back. */
  step(frames: number): void {
    this.playing = false;
    this.seek(Math.round(this.framePosition) + frames);
  }

  /** After `elapsed` seconds. */
  advance(elapsed: number): void {
    if (!this.playing) return;
    // A tab that slept goes on where it was.
    this.framePosition += Math.min(elapsed, 0.25) * this.rate * this.speed;
    if (this.framePosition >= this.lastFrame) {
      if (this.loop && this.lastFrame > 0) this.framePosition %= this.lastFrame;
      else {
        this.framePosition = this.lastFrame;
        this.playing = false;
      }
    }
    this.onChange();
  }
}
