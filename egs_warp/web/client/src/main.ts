// Entry point: find the runs of the page and show them.

import { element } from "./dom";
import { Page } from "./page";
import { earlyKeys } from "./early_keys";
import { showStill, takeAction } from "./reload";
import { fromAddress, fromElement, fromSocket, type ConnectionState, type FrameSource } from "./frame_source";
import "./controls.css";
import "./style.css";

const LOADING = "Loading\u2026";
const TAKE_OVER = "Control the creature from this page";

/** Return the runs of this page, which are embedded in it, come from a socket, or are files on the server. */
async function findRuns(): Promise<FrameSource[]> {
  const embedded = [...document.querySelectorAll<HTMLElement>("script[data-run]")];
  if (embedded.length > 0) return Promise.all(embedded.map(fromElement));
  const parameters = new URLSearchParams(location.search);
  if (parameters.has("live")) {
    const address = new URL("live", location.href);
    address.protocol = address.protocol.replace("http", "ws");
    address.search = "";
    return [await fromSocket(address.href, showConnection)];
  }
  const count = Number(parameters.get("runs") ?? "1");
  return Promise.all(Array.from({ length: count }, (_, k) => fromAddress(`run/${k}`)));
}

/** Message about the connection, with a button to take the session over; it is changed only when its text changes,
 * because the page tries to reconnect twice a second. */
let notice: HTMLElement | undefined;

/** Show why there is no connection or no header; undefined means that the header has arrived. */
function showConnection(state: ConnectionState | undefined): void {
  const isOpen = window.egs !== undefined;
  document.body.classList.toggle("lost", isOpen && state !== undefined);
  for (const controls of document.querySelectorAll<HTMLElement>(".dock, .sheet, .toasts, .panel")) {
    controls.inert = isOpen && state !== undefined && !state.preparing;
  }
  if (notice?.isConnected && notice.firstChild?.textContent === state?.text) return;
  notice?.remove();
  notice = undefined;
  if (state === undefined) {
    if (!isOpen) showMessage(LOADING);
    return;
  }
  const { text, failed, preparing, takeOver } = state;
  if (preparing) earlyKeys.start();
  if (failed || takeOver !== undefined) earlyKeys.stop();
  notice = element("div", { class: "message", role: "alert" }, element("span", {}, text));
  notice.classList.toggle("wrong", failed === true);
  if (takeOver !== undefined) {
    const taking = element("button", { type: "button", class: "take", title: TAKE_OVER }, "Take over");
    taking.addEventListener("click", takeOver);
    notice.append(taking);
  }
  if (isOpen) document.body.append(notice);
  else document.getElementById("page")?.replaceChildren(notice);
}

function showMessage(message: string): void {
  document.getElementById("page")?.replaceChildren(element("p", { class: "message", role: "alert" }, message));
}

declare global {
  interface Window {
    /** Access for scripts that control the page. */
    egs?: Page;
  }
}

async function start(): Promise<void> {
  const root = document.getElementById("page") as HTMLElement;
  showMessage(LOADING);
  const fadeStill = showStill();
  // A page that follows the preparation receives its creature only after some time.
  const early = takeAction();
  if (early !== undefined) earlyKeys.resume(early.action);
  // A picture of the previous page covers the page until the first image is drawn; without one, a text says why the
  // page is still empty.
  const drawing = element("p", { class: "message drawing", role: "status" }, "Drawing the capture\u2026");
  try {
    window.egs = new Page(root, await findRuns());
    if (fadeStill === undefined) root.append(drawing);
    await window.egs.drawn;
    drawing.remove();
    fadeStill?.();
  } catch (error) {
    fadeStill?.();
    earlyKeys.stop();
    showMessage(error instanceof Error ? error.message : String(error));
  }
}

void start();
