// Playback state of recorded runs.

/** Properties of the film that is played: index of its last frame, and frames per second. */
export interface Film {
  readonly lastFrame: number;
  readonly rate: number;
}

export class Player {
  playing = false;
  loop = true;
  speed = 1;
  /** Fractional index of the frame that is shown. */
  framePosition = 0;

  constructor(
    private readonly film: Film,
    private readonly onChange: () => void,
  ) {}

  get lastFrame(): number {
    return this.film.lastFrame;
  }

  get rate(): number {
    return this.film.rate;
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
    // Limit the step, so that a tab that was in the background continues at the frame at which it stopped.
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
