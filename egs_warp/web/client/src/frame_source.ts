// Sources of frames: a file with all frames of a run, or a socket that receives frames during the simulation.

import type { PickNews } from "./pick_news";
import { preparationText } from "./preparation_text";
import { readFrame, readFrames, readHeader, type Facts, type Frame, type Header, type Style } from "./packets";

export interface FrameSource {
  readonly header: Header;
  /** All frames that have been received so far, in order of time. */
  readonly frames: Frame[];
  /** True if more frames may arrive. */
  readonly isOpen: boolean;
  /** Function that is called for each frame that arrives later. */
  onFrame: (frame: Frame) => void;
}

/** Read a file of one complete run. */
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

/** Read a run embedded in the page as base64 of gzip. */
export async function fromElement(element: HTMLElement): Promise<FrameSource> {
  const text = element.textContent?.trim() ?? "";
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return fromBytes(await new Response(unpacked).arrayBuffer());
}

/** Messages from a session other than frames. */
export type News =
  | {
      type: "state";
      /** Name of the body of a world that this page steers, and the current motion of each body. */
      body?: string;
      bodies?: Record<string, string>;
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
      /** Number of pushes that have acted on the creature. */
      pushes: number;
      /** Number of pushes that a reset has removed before they acted. */
      dropped_pushes: number;
      step: number;
    }
  | { type: "told"; text: string }
  | { type: "script"; text: string; motions: number }
  | { type: "busy"; on: boolean }
  | {
      type: "preparing";
      stage: string;
      /** Camera that shows the front of the body, once it is known. */
      camera?: Facts["camera"];
      /** One line about the body. */
      note?: string;
    }
  | { type: "failed"; text: string }
  | { type: "ready" }
  | PickNews
  | { type?: undefined; error: string };

/** A live session: receives frames and messages, and sends commands. */
export class LiveSource implements FrameSource {
  readonly frames: Frame[] = [];
  isOpen = true;
  /** True if the server has sent nothing for longer than it does while it runs. */
  isSilent = false;
  onFrame: (frame: Frame) => void = () => {};
  onNews: (news: News) => void = () => {};
  private pendingNews: News[] | undefined = [];

  constructor(
    readonly header: Header,
    public socket: WebSocket,
  ) {}

  get isConnected(): boolean {
    return this.socket.readyState === WebSocket.OPEN && !this.isSilent;
  }

  send(message: Record<string, unknown>): void {
    if (this.isConnected) this.socket.send(JSON.stringify(message));
  }

  /** Set the message handler and call it for the messages that arrived earlier. */
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
    // A reset puts the creature elsewhere at the same time.
    if (last !== undefined && frame.time < last.time) this.frames.length = 0;
    else if (last !== undefined && frame.time === last.time) {
      this.frames.pop();
      frame.isReset = true;
    }
    this.frames.push(frame);
    this.onFrame(frame);
  }
}

/** Code with which the server closes the socket while another page shows the session (RFC 6455). */
const TRY_AGAIN_LATER = 1013;
/** Codes with which the server closes the socket at its end (RFC 6455). */
const ENDED = [1001, 1012];
const ENDED_TEXT =
  "egs-warp has ended. To continue, start it again in the terminal, and open the address that it prints.";
const LOST_TEXT = "The connection to egs-warp is lost; trying again\u2026";
const GONE_TEXT =
  "There is no connection to egs-warp: it has ended, or the network is interrupted. Look at its terminal; if it has " +
  "ended, start it again, and open the address that it prints.";
const CONTINUES_TEXT = " If it still runs, this page goes on by itself.";
const SILENT_TEXT =
  "egs-warp does not answer: it is stopped or very busy, or the network is interrupted. Look at its terminal; this " +
  "page goes on by itself.";
/** Message with which the server only says that it is there. */
const ALIVE = '{"type": "alive"}';
/** Time after which the page tries to reconnect, ms. */
const RETRY_TIME = 500;
/** Time without a connection after which the page says what may have happened, ms. */
const GONE_TIME = 4000;
/** Time without a message after which the server does not answer, ms; while it runs, it sends one every two seconds
 * (egs_warp/web/server.py). */
const MAX_SILENCE = 8000;
/** Time without a message after which the page reconnects, ms: an interrupted network may leave a socket open on which
 * nothing arrives any more. */
const RECONNECT_SILENCE = 3 * MAX_SILENCE;

/** What the page shows while it has no connection or no header. */
export interface ConnectionState {
  text: string;
  /** True if nothing more can be expected. */
  failed?: boolean;
  /** True while the body is prepared. */
  preparing?: boolean;
  /** Take the session over from another page; undefined if no other page has it. */
  takeOver?: () => void;
}

/** Connect to a session. Wait for as long as another page shows the session, and reconnect after a lost connection. The
 * header, before which stages of the preparation may come, is followed by frames and messages. `onState` is called with
 * undefined when the header has arrived. */
export function fromSocket(
  address: string,
  onState: (state: ConnectionState | undefined) => void,
): Promise<LiveSource> {
  return new Promise((resolve, reject) => {
    let source: LiveSource | undefined;
    let current: WebSocket | undefined;
    let retry = 0;
    let failed = false;
    let ended = false;
    let lastMessage = performance.now();
    /** True if the current socket has received the header, after which the server sends messages all the time. */
    let hasHeader = false;
    /** Time at which the connection was lost; undefined while there is one. */
    let lostAt: number | undefined;
    /** What the page shows apart from a silence of the server. */
    let state: ConnectionState | undefined;
    const show = (next: ConnectionState | undefined): void => {
      state = next;
      onState(next);
    };
    const setSilent = (isSilent: boolean): void => {
      if (source !== undefined) source.isSilent = isSilent;
      onState(isSilent ? { text: SILENT_TEXT } : state);
    };
    let isSilent = false;
    setInterval(() => {
      const isOpen = current?.readyState === WebSocket.OPEN;
      const silence = performance.now() - lastMessage;
      if (!isOpen || !hasHeader || failed || silence < MAX_SILENCE) return;
      if (!isSilent) {
        isSilent = true;
        setSilent(true);
      } else if (silence > RECONNECT_SILENCE) {
        // While the server still has the old socket, it answers that the session is in use, and the page tries again.
        current!.onmessage = null;
        current!.close();
        connect();
      }
    }, 1000);
    const takeOver = (): void => {
      clearTimeout(retry);
      connect("?take");
    };
    const connect = (query = ""): void => {
      const socket = new WebSocket(address + query);
      current = socket;
      hasHeader = false;
      socket.binaryType = "arraybuffer";
      let first = true;
      socket.onmessage = ({ data }: MessageEvent<ArrayBuffer | string>) => {
        lastMessage = performance.now();
        if (isSilent) {
          isSilent = false;
          setSilent(false);
        }
        if (data === ALIVE) return;
        if (first && typeof data === "string") {
          const news = JSON.parse(data) as News;
          failed = news.type === "failed";
          if (news.type === "preparing") show({ text: preparationText(news.stage), preparing: true });
          else if (news.type === "failed") show({ text: news.text, failed });
          return;
        }
        if (first) {
          first = false;
          hasHeader = true;
          const { header } = readHeader(data as ArrayBuffer);
          // Continue after a reconnection to the same session; reload the page if the session is another one.
          if (source === undefined) source = new LiveSource(header, socket);
          else if (source.header.facts.session !== header.facts.session) location.reload();
          else source.socket = socket;
          ended = false;
          lostAt = undefined;
          show(undefined);
          return;
        }
        source?.receive(data);
        if (source?.frames.length === 1) resolve(source);
      };
      socket.onclose = ({ code, reason }) => {
        // The user has taken the session over with another socket, or there will be no session.
        if (socket !== current || failed) return;
        isSilent = false;
        if (source !== undefined) source.isSilent = false;
        ended ||= ENDED.includes(code);
        lostAt ??= performance.now();
        const isGone = performance.now() - lostAt > GONE_TIME;
        if (code === TRY_AGAIN_LATER) {
          lostAt = undefined;
          show({ text: reason, takeOver });
        } else if (source === undefined) {
          reject(new Error(ended ? ENDED_TEXT : reason || GONE_TEXT));
          return;
        } else if (code === 1000) {
          source.isOpen = false;
          return;
        } else if (ended) show({ text: ENDED_TEXT });
        else show({ text: isGone ? GONE_TEXT + CONTINUES_TEXT : LOST_TEXT });
        retry = setTimeout(connect, RETRY_TIME);
      };
    };
    connect();
  });
}
