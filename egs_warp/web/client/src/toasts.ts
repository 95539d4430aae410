// Messages to the user that disappear after a few seconds.

import { element } from "./dom";

/** Time for which a message is shown, ms. */
const TOAST_TIME = 7000;
const MAX_TOASTS = 3;

export class Toasts {
  readonly element: HTMLElement;
  private readonly list = element("div", { class: "list", role: "status", "aria-live": "polite" });

  /** Show the elements `lasting` below the messages, where they stay until they are hidden. */
  constructor(...lasting: HTMLElement[]) {
    this.element = element("div", { class: "toasts" }, this.list, ...lasting);
  }

  show(line: string, isError = false): void {
    const toast = element("p", { class: isError ? "toast wrong" : "toast" }, line);
    this.list.append(toast);
    while (this.list.childElementCount > MAX_TOASTS) this.list.firstElementChild?.remove();
    setTimeout(() => toast.remove(), TOAST_TIME);
  }
}
