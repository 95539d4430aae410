// Messages to the user that disappear after a few seconds.

import { element } from "./dom";

/** Time for which a message is shown, ms. */
const TOAST_TIME = 7000;
const MAX_TOASTS = 3;

export class Toasts {
  readonly element = element("div", { class: "toasts", role: "status", "aria-live": "polite" });

  show(line: string, isError = false): void {
    const toast = element("p", { class: isError ? "toast wrong" : "toast" }, line);
    this.element.append(toast);
    while (this.element.childElementCount > MAX_TOASTS) this.element.firstElementChild?.remove();
    setTimeout(() => toast.remove(), TOAST_TIME);
  }
}
