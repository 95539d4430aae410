// Entry point: find the runs of the page and show them.

import { element } from "./dom";
import { Page } from "./page";
import { showStill } from "./still";
import { fromAddress, fromElement, fromSocket, type FrameSource } from "./frame_source";
import "./controls.css";
import "./style.css";

const LOADING = "Loading\u2026";

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

/** Show the reason why the connection is lost; undefined means that the connection has been restored. */
function showConnection(reason: string | undefined): void {
  if (window.egs === undefined) {
    showMessage(reason ?? LOADING);
    return;
  }
  document.body.classList.toggle("lost", reason !== undefined);
  document.body.dataset.lost = reason ?? "";
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
  try {
    window.egs = new Page(root, await findRuns());
    await window.egs.drawn;
    fadeStill();
  } catch (error) {
    fadeStill();
    showMessage(error instanceof Error ? error.message : String(error));
  }
}

void start();
