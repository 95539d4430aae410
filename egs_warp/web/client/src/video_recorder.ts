// Recorder of the canvas in real time, and encoders of the frames of a run.

import {
  BufferTarget,
  getFirstEncodableVideoCodec,
  Mp4OutputFormat,
  Output,
  Quality,
  VideoSample,
  VideoSampleSource,
  type VideoCodec,
} from "mediabunny";

const MIME_TYPES = ["video/mp4;codecs=avc1", "video/webm;codecs=vp9", "video/webm"];
/** Codecs of MP4 files: H.264, and VP9 for browsers without H.264 and for larger pictures. */
const CODECS: VideoCodec[] = ["avc", "vp9"];
/** Bits per second of a video. */
const BITRATE = 16e6;
/** Maximum time between two frames that can be decoded without the earlier ones, s. */
const KEY_TIME = 1;

/** A video: its content, and the extension of its file. */
export interface Video {
  blob: Blob;
  extension: string;
}

export class VideoRecorder {
  private recorder: MediaRecorder | undefined;

  get recording(): boolean {
    return this.recorder !== undefined;
  }

  /** Start recording. The method `stop` passes the video to `onFinished`. */
  start(canvas: HTMLCanvasElement, onFinished: (video: Video) => void): void {
    const { recorder, video } = streamRecorder(canvas.captureStream(60));
    recorder.start();
    this.recorder = recorder;
    void video.then(onFinished);
  }

  stop(): void {
    this.recorder?.stop();
    this.recorder = undefined;
  }
}

/** Encoder of the frames of a run. Each frame lasts equally long, however long it takes to draw. */
export interface FrameEncoder {
  /** Add the picture that was drawn in the same task. */
  add(): Promise<void>;
  finish(): Promise<Video>;
  /** Stop without a video. */
  cancel(): void;
}

/** Return an encoder of pictures of `canvas`, which must keep its size; `rate` is in frames per second. */
export async function frameEncoder(canvas: HTMLCanvasElement, rate: number): Promise<FrameEncoder> {
  // The chroma of a video has half of its resolution.
  const [width, height] = [canvas.width & ~1, canvas.height & ~1];
  const quality = new Quality({ bitrate: BITRATE });
  // Browsers provide WebCodecs only to pages with https or from the same machine.
  const codec = await getFirstEncodableVideoCodec(CODECS, { width, height, quality, frameRate: rate });
  if (codec === null) return new PacedEncoder(canvas, rate);
  const source = new VideoSampleSource({ codec, quality, keyFrameInterval: KEY_TIME });
  const output = new Output({ format: new Mp4OutputFormat(), target: new BufferTarget() });
  output.addVideoTrack(source, { frameRate: rate });
  await output.start();
  return new CodecEncoder(canvas, rate, { width, height }, source, output);
}

/** Encoder that gives each frame its time in the video. */
class CodecEncoder implements FrameEncoder {
  private count = 0;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly rate: number,
    private readonly size: { width: number; height: number },
    private readonly source: VideoSampleSource,
    private readonly output: Output<Mp4OutputFormat, BufferTarget>,
  ) {}

  async add(): Promise<void> {
    const { canvas, rate, size, source } = this;
    const frame = new VideoFrame(canvas, { timestamp: 0, visibleRect: { x: 0, y: 0, ...size } });
    const sample = new VideoSample(frame, { timestamp: this.count++ / rate, duration: 1 / rate });
    await source.add(sample);
    sample.close();
  }

  async finish(): Promise<Video> {
    await this.output.finalize();
    return { blob: new Blob([this.output.target.buffer!], { type: "video/mp4" }), extension: "mp4" };
  }

  cancel(): void {
    if (this.output.state === "started") void this.output.cancel();
  }
}

/** Encoder for browsers that can only record in real time: it records each picture for the duration of one frame, and
 * pauses while the next one is drawn. */
class PacedEncoder implements FrameEncoder {
  private readonly recorder: MediaRecorder;
  private readonly track: CanvasCaptureMediaStreamTrack;
  private readonly video: Promise<Video>;
  private count = 0;
  /** Recorded time, ms. */
  private recorded = 0;

  constructor(
    canvas: HTMLCanvasElement,
    private readonly rate: number,
  ) {
    const stream = canvas.captureStream(0);
    this.track = stream.getVideoTracks()[0] as CanvasCaptureMediaStreamTrack;
    ({ recorder: this.recorder, video: this.video } = streamRecorder(stream));
  }

  async add(): Promise<void> {
    const { recorder, track, rate } = this;
    if (this.count === 0) recorder.start();
    else recorder.resume();
    const start = performance.now();
    track.requestFrame();
    this.count++;
    // Timers are late, so the time that is left is measured from the start of the video.
    const left = (1000 * this.count) / rate - this.recorded;
    await new Promise((resolve) => setTimeout(resolve, Math.max(left, 1)));
    recorder.pause();
    this.recorded += performance.now() - start;
  }

  finish(): Promise<Video> {
    this.recorder.stop();
    return this.video;
  }

  cancel(): void {
    if (this.recorder.state !== "inactive") this.recorder.stop();
  }
}

/** Return a recorder of `stream`, and its video, which is complete when the recorder has stopped. */
function streamRecorder(stream: MediaStream): { recorder: MediaRecorder; video: Promise<Video> } {
  const mimeType = MIME_TYPES.find((one) => MediaRecorder.isTypeSupported(one));
  if (mimeType === undefined) throw new Error("this browser cannot record video");
  const chunks: Blob[] = [];
  const recorder = new MediaRecorder(stream, { mimeType, videoBitsPerSecond: BITRATE });
  recorder.ondataavailable = ({ data }) => chunks.push(data);
  const extension = mimeType.startsWith("video/mp4") ? "mp4" : "webm";
  const video = new Promise<Video>((resolve) => {
    recorder.onstop = () => resolve({ blob: new Blob(chunks, { type: mimeType }), extension });
  });
  return { recorder, video };
}
