// Playback state of recorded runs.

import type { FrameSource } from "./frame_source";

export class Player {
  playing = false;
  loop = true;
  speed = 1;
  /** Fractional index of the frame that is shown. */
  framePosition = 0;

  constructor(
    private readonly sources: FrameSource[],
    private readonly onChange: () => void,
  ) {}

  /** Last frame of the longest run; shorter runs stay at their last frame. */
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

  /** Pause and move by a number of frames. */
  step(frames: number): void {
    this.playing = false;
    this.seek(Math.round(this.framePosition) + frames);
  }

  /** Advance the playback by `elapsed` seconds. */
  advance(elapsed: number): void {
    if (!this.playing) return;
    // Limit the step, so that a tab that was in the background continues where it stopped.
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
