// The canvas as a video file, recorded while the run plays once.

const KINDS = ["video/mp4;codecs=avc1", "video/webm;codecs=vp9", "video/webm"];

export class FilmRecorder {
  private recorder: MediaRecorder | undefined;

  get recording(): boolean {
    return this.recorder !== undefined;
  }

  /** Begins; what was recorded is given to `done` after `stop`. */
  start(canvas: HTMLCanvasElement, done: (blob: Blob, ending: string) => void): void {
    const kind = KINDS.find((one) => MediaRecorder.isTypeSupported(one));
    if (kind === undefined) throw new Error("this browser records no video");
    const pieces: Blob[] = [];
    const recorder = new MediaRecorder(canvas.captureStream(60), { mimeType: kind, videoBitsPerSecond: 16e6 });
    recorder.ondataavailable = ({ data }) => pieces.push(data);
    recorder.onstop = () => done(new Blob(pieces, { type: kind }), kind.startsWith("video/mp4") ? "mp4" : "webm");
    recorder.start();
    this.recorder = recorder;
  }

  stop(): void {
    this.recorder?.stop();
    this.recorder = undefined;
  }
}
