// Where frames come from: a file that holds them all, or a socket that sends them as they are made.

import { readFrame, readFrames, readHeader, type Frame, type Header, type Style } from "./packets";

export interface FrameSource {
  readonly header: Header;
  /** All frames known so far, in order; a socket's grow. */
  readonly frames: Frame[];
  /** Whether more may come. */
  readonly isOpen: boolean;
  /** Told of each frame that comes later. */
  onFrame: (frame: Frame) => void;
}

/** A file of one run; `.open` never is. */
export function fromBytes(bytes: ArrayBuffer): FrameSource {
  const { header, end } = readHeader(bytes);
  const frames = readFrames(bytes, end);
  if (frames.length === 0) throw new Error("the run has no frames");
  return { header, frames, isOpen: false, onFrame: () => {} };
}

export async function fromAddress(address: string): Promise<FrameSource> {
  const response = await fetch(address);
  if (!response.ok) throw new Error(`the run cannot be read (${response.status}): is egs-warp view still running?`);
  return fromBytes(await response.arrayBuffer());
}

/** Runs that a page carries within itself: base64 of gzip. */
export async function fromElement(element: HTMLElement): Promise<FrameSource> {
  const text = element.textContent?.trim() ?? "";
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return fromBytes(await new Response(unpacked).arrayBuffer());
}

/** What a session says beside its frames. */
export type News =
  | {
      type: "state";
      doing: string;
      queued: string | null;
      walks: boolean;
      goal: [number, number] | null;
      facing: [number, number];
      paused: boolean;
      resting: boolean;
      recording: boolean;
      pulled: boolean;
      friction: number;
      sag: number;
      style: Style;
      motions: number;
      step: number;
    }
  | { type: "told"; text: string }
  | { type: "script"; text: string; motions: number }
  | { type: "busy"; on: boolean }
  | { type?: undefined; error: string };

/** A session that lives: frames as they are made, news beside them, and a way to ask for something. */
export class LiveSource implements FrameSource {
  readonly frames: Frame[] = [];
  isOpen = true;
  onFrame: (frame: Frame) => void = () => {};
  onNews: (news: News) => void = () => {};
  private pendingNews: News[] | undefined = [];

  constructor(
    readonly header: Header,
    public socket: WebSocket,
  ) {}

  send(message: Record<string, unknown>): void {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  /** News that came before anybody listened are told then. */
  listen(onNews: (news: News) => void): void {
    this.onNews = onNews;
    for (const news of this.pendingNews ?? []) onNews(news);
    this.pendingNews = undefined;
  }

  receive(data: ArrayBuffer | string): void {
    if (typeof data === "string") {
      const news = JSON.parse(data) as News;
      if (this.pendingNews !== undefined) this.pendingNews.push(news);
      this.onNews(news);
      return;
    }
    const frame = readFrame(data, 0);
    const last = this.frames.at(-1);
    // Another beginning, or a moment that is known already.
    if (last !== undefined && frame.time < last.time) this.frames.length = 0;
    else if (last !== undefined && frame.time === last.time) this.frames.pop();
    this.frames.push(frame);
    this.onFrame(frame);
  }
}

/** A socket: the header comes first, then frames and news. A lost connection is taken up again. */
export function fromSocket(address: string, onState: (lost: string | undefined) => void): Promise<LiveSource> {
  return new Promise((resolve, reject) => {
    let source: LiveSource | undefined;
    const connect = (): void => {
      const socket = new WebSocket(address);
      socket.binaryType = "arraybuffer";
      let first = true;
      socket.onmessage = ({ data }: MessageEvent<ArrayBuffer | string>) => {
        if (first) {
          first = false;
          const { header } = readHeader(data as ArrayBuffer);
          // After a lost connection the same session goes on; another one has another creature.
          if (source === undefined) source = new LiveSource(header, socket);
          else if (source.header.facts.session !== header.facts.session) location.reload();
          else source.socket = socket;
          onState(undefined);
          return;
        }
        source?.receive(data);
        if (source?.frames.length === 1) resolve(source);
      };
      socket.onclose = ({ code, reason }) => {
        if (source === undefined) reject(new Error(reason || `no connection (${code})`));
        else if (code === 1000) source.isOpen = false;
        else {
          onState(reason || "connection lost, trying again");
          setTimeout(connect, 500);
        }
      };
    };
    connect();
  });
}
