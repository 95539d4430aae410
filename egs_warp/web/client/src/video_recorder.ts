// Recorder of the canvas in real time, and encoders of the frames of a run.

import { mp4File } from "./mp4";

const MIME_TYPES = ["video/mp4;codecs=avc1", "video/webm;codecs=vp9", "video/webm"];
/** Codecs of MP4 files: the constrained baseline profile of H.264, whose frames are stored in order of time, and VP9
 * for browsers without H.264 and for larger pictures. */
const CODECS = ["avc1.42E034", "vp09.00.62.08"];
/** Bits per second of a video. */
const BITRATE = 16e6;
/** Maximum time between two frames that can be decoded without the earlier ones, s. */
const KEY_TIME = 1;
/** Maximum number of frames that wait for the encoder. */
const MAX_WAITING = 4;

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
  // Browsers provide WebCodecs only to pages with https or from the same machine.
  if (typeof VideoEncoder !== "undefined") {
    for (const codec of CODECS) {
      const config = encoderConfig(canvas, rate, codec);
      if ((await VideoEncoder.isConfigSupported(config)).supported) return new CodecEncoder(canvas, rate, config);
    }
  }
  return new PacedEncoder(canvas, rate);
}

function encoderConfig(canvas: HTMLCanvasElement, rate: number, codec: string): VideoEncoderConfig {
  // The chroma of a video has half of its resolution.
  const [width, height] = [canvas.width & ~1, canvas.height & ~1];
  const avc: Partial<VideoEncoderConfig> = codec.startsWith("avc1") ? { avc: { format: "avc" } } : {};
  return { codec, width, height, framerate: rate, bitrate: BITRATE, ...avc };
}

/** Encoder that gives each frame its time in the video. */
class CodecEncoder implements FrameEncoder {
  private readonly encoder: VideoEncoder;
  private readonly frames: { data: Uint8Array<ArrayBuffer>; isKey: boolean }[] = [];
  private description = new Uint8Array();
  private error: Error | undefined;
  private count = 0;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly rate: number,
    private readonly config: VideoEncoderConfig,
  ) {
    this.encoder = new VideoEncoder({
      output: (chunk, metadata) => this.store(chunk, metadata),
      error: (error) => {
        this.error = error;
      },
    });
    this.encoder.configure(config);
  }

  async add(): Promise<void> {
    const { canvas, rate, encoder, count, config } = this;
    const { width, height } = config;
    const time = (k: number): number => Math.round((1e6 * k) / rate);
    const [timestamp, duration] = [time(count), time(count + 1) - time(count)];
    const frame = new VideoFrame(canvas, { timestamp, duration, visibleRect: { x: 0, y: 0, width, height } });
    encoder.encode(frame, { keyFrame: count % Math.max(1, Math.round(KEY_TIME * rate)) === 0 });
    frame.close();
    this.count++;
    while (encoder.encodeQueueSize > MAX_WAITING && this.error === undefined) {
      await new Promise((resolve) => encoder.addEventListener("dequeue", resolve, { once: true }));
    }
    if (this.error !== undefined) throw this.error;
  }

  async finish(): Promise<Video> {
    await this.encoder.flush();
    if (this.error !== undefined) throw this.error;
    this.encoder.close();
    const { frames, description, rate } = this;
    const { codec, width, height } = this.config;
    return { blob: mp4File({ width, height, rate, codec, description, frames }), extension: "mp4" };
  }

  cancel(): void {
    if (this.encoder.state !== "closed") this.encoder.close();
  }

  private store(chunk: EncodedVideoChunk, metadata?: EncodedVideoChunkMetadata): void {
    const data = new Uint8Array(chunk.byteLength);
    chunk.copyTo(data);
    this.frames.push({ data, isKey: chunk.type === "key" });
    const description = metadata?.decoderConfig?.description;
    if (description === undefined) return;
    this.description = new Uint8Array(
      ArrayBuffer.isView(description)
        ? description.buffer.slice(description.byteOffset, description.byteOffset + description.byteLength)
        : description,
    ) as Uint8Array<ArrayBuffer>;
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
