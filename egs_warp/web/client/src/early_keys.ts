// Keys that are pressed before the body of a live session is ready: a motion is queued, any other request is refused.

import { element } from "./dom";
import { actionOfKey, ACTION_NAMES, type Action } from "./input";

/** Other keys of a live session. */
const OTHER_KEYS = new Set(["b", "m", "p", "r", ".", "?", "Backspace"]);
const NOT_READY = "The body is not ready yet.";
/** Time for which the answer to a key that queues no motion is shown, ms. */
const ANSWER_TIME = 4000;

class EarlyKeys {
  readonly element = element("p", { class: "answer", role: "status", "aria-live": "polite" });
  /** Motion that starts when the body is ready. */
  action: Action | undefined;
  private timeout: ReturnType<typeof setTimeout> | undefined;
  private readonly onKey = (event: KeyboardEvent): void => this.keyDown(event);

  /** Answer to keys from now on. */
  start(): void {
    document.addEventListener("keydown", this.onKey);
    if (!this.element.isConnected) document.body.append(this.element);
  }

  /** Answer to keys from now on, after a page on which `action` was queued. */
  resume(action: Action | undefined): void {
    this.action = action;
    this.start();
    this.showQueue();
  }

  /** Ignore keys from now on. */
  stop(): void {
    document.removeEventListener("keydown", this.onKey);
    this.element.remove();
  }

  /** Tell the user that a request needs the body. */
  refuse(): void {
    this.answer(NOT_READY);
  }

  /** Show `text` for a while, and then the queued motion. */
  private answer(text: string): void {
    this.element.textContent = text;
    clearTimeout(this.timeout);
    this.timeout = setTimeout(() => this.showQueue(), ANSWER_TIME);
  }

  private showQueue(): void {
    clearTimeout(this.timeout);
    const name = this.action && ACTION_NAMES[this.action];
    this.element.textContent = name ? `Queued: ${name}. It starts when the body is ready; Esc cancels it.` : "";
  }

  private keyDown(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    const action = actionOfKey(event);
    if (action !== undefined) {
      this.action = action;
      this.showQueue();
    } else if (event.key === "Escape") {
      if (this.action !== undefined) this.answer(`Cancelled: ${ACTION_NAMES[this.action]}.`);
      this.action = undefined;
    } else if (OTHER_KEYS.has(event.key)) this.refuse();
    else return;
    event.preventDefault();
  }
}

/** The keys of this page. */
export const earlyKeys = new EarlyKeys();
