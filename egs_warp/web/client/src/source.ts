// Where frames come from: a file that holds them all, or a socket that sends them as they are made.

import { readFrame, readFrames, readHeader, type Frame, type Header } from "./packets";

export interface FrameSource {
  readonly header: Header;
  /** All frames known so far, in order; a socket's grow. */
  readonly frames: Frame[];
  /** Whether more may come. */
  readonly open: boolean;
  /** Told of each frame that comes later. */
  onFrame: (frame: Frame) => void;
}

/** A file of one run; `.open` never is. */
export function fromBytes(bytes: ArrayBuffer): FrameSource {
  const { header, end } = readHeader(bytes);
  const frames = readFrames(bytes, end);
  if (frames.length === 0) throw new Error("the run has no frames");
  return { header, frames, open: false, onFrame: () => {} };
}

export async function fromAddress(address: string): Promise<FrameSource> {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(`the run cannot be read (${answer.status}): is egs-warp view still running?`);
  return fromBytes(await answer.arrayBuffer());
}

/** Runs that a page carries within itself: base64 of gzip. */
export async function fromElement(element: HTMLElement): Promise<FrameSource> {
  const text = element.textContent?.trim() ?? "";
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return fromBytes(await new Response(unpacked).arrayBuffer());
}

/** A socket: the header comes first, then frames. A lost connection is taken up again. */
export function fromSocket(address: string, onState: (connected: boolean) => void): Promise<FrameSource> {
  return new Promise((resolve, reject) => {
    let source: (FrameSource & { open: boolean }) | undefined;
    const connect = (): void => {
      const socket = new WebSocket(address);
      socket.binaryType = "arraybuffer";
      let first = true;
      socket.onopen = () => onState(true);
      socket.onmessage = ({ data }: MessageEvent<ArrayBuffer>) => {
        if (first) {
          first = false;
          // The same header again after a lost connection: what is on the page stays.
          if (source !== undefined) return;
          source = { header: readHeader(data).header, frames: [], open: true, onFrame: () => {} };
          return;
        }
        if (source === undefined) return;
        const frame = readFrame(data, 0);
        source.frames.push(frame);
        if (source.frames.length === 1) resolve(source);
        source.onFrame(frame);
      };
      socket.onclose = ({ code, reason }) => {
        onState(false);
        if (source === undefined) reject(new Error(reason || `no connection (${code})`));
        else if (code === 1000) source.open = false;
        else setTimeout(connect, 500);
      };
    };
    connect();
  });
}
