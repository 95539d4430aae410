// Video of a whole run, which is drawn and encoded frame by frame; a line shows the progress.

import { element } from "./dom";
import { frameEncoder, type Video } from "./video_recorder";

/** A run that can be drawn frame by frame. */
export interface FilmedRun {
  canvas: HTMLCanvasElement;
  /** Frames per second. */
  rate: number;
  frameCount: number;
  /** Draw a frame completely on `canvas`, which keeps the picture until the end of the task. */
  draw(frame: number): Promise<void>;
}

export class RunVideo {
  readonly element: HTMLElement;
  private readonly text = element("span", { role: "status" });
  private readonly progress = element("progress", { "aria-label": "Recorded frames" });
  private isRecording = false;
  private isCancelled = false;

  constructor() {
    const hint = "Stop without a video (Escape)";
    const cancel = element("button", { type: "button", class: "action", title: hint }, "Cancel");
    cancel.addEventListener("click", () => this.cancel());
    this.element = element("div", { class: "recording", hidden: "" }, this.text, this.progress, cancel);
  }

  get recording(): boolean {
    return this.isRecording;
  }

  cancel(): void {
    this.isCancelled = true;
  }

  /** Return the video of `run`; undefined if the user cancels. */
  async record({ canvas, rate, frameCount, draw }: FilmedRun): Promise<Video | undefined> {
    this.isRecording = true;
    this.isCancelled = false;
    this.progress.max = frameCount;
    this.showProgress(0);
    this.element.hidden = false;
    try {
      const encoder = await frameEncoder(canvas, rate);
      try {
        for (let frame = 0; frame < frameCount && !this.isCancelled; frame++) {
          await draw(frame);
          await encoder.add();
          this.showProgress(frame + 1);
        }
        return this.isCancelled ? undefined : await encoder.finish();
      } finally {
        encoder.cancel();
      }
    } finally {
      this.isRecording = false;
      this.element.hidden = true;
    }
  }

  private showProgress(done: number): void {
    this.progress.value = done;
    this.text.textContent = `Video: frame ${done} of ${this.progress.max}`;
  }
}
