// Recorder of the canvas as a video file.

const MIME_TYPES = ["video/mp4;codecs=avc1", "video/webm;codecs=vp9", "video/webm"];

export class VideoRecorder {
  private recorder: MediaRecorder | undefined;

  get recording(): boolean {
    return this.recorder !== undefined;
  }

  /** Start recording. The method `stop` passes the video to `onFinished`. */
  start(canvas: HTMLCanvasElement, onFinished: (blob: Blob, ending: string) => void): void {
    const mimeType = MIME_TYPES.find((one) => MediaRecorder.isTypeSupported(one));
    if (mimeType === undefined) throw new Error("this browser cannot record video");
    const chunks: Blob[] = [];
    const recorder = new MediaRecorder(canvas.captureStream(60), { mimeType, videoBitsPerSecond: 16e6 });
    recorder.ondataavailable = ({ data }) => chunks.push(data);
    const extension = mimeType.startsWith("video/mp4") ? "mp4" : "webm";
    recorder.onstop = () => onFinished(new Blob(chunks, { type: mimeType }), extension);
    recorder.start();
    this.recorder = recorder;
  }

  stop(): void {
    this.recorder?.stop();
    this.recorder = undefined;
  }
}
