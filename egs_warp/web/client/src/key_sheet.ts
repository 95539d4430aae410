// Overview of the functions of keys and pointer.

import { element } from "./dom";

/** True on a device that has a touch screen and no mouse. */
const IS_TOUCH = window.matchMedia("(any-hover: none) and (any-pointer: coarse)").matches;
/** Title and label of the button that opens the sheet. */
export const SHEET_TITLE = IS_TOUCH ? "Touch controls" : "Keys (?)";
export const SHEET_LABEL = IS_TOUCH ? "touch" : "keys";

/** Create a hidden sheet. Each entry consists of keys or movements of fingers and a description of their function. On
 * a device that has only a touch screen, the sheet shows the entries `touch` instead. */
export function createKeySheet(entries: [string[], string][], touch: [string[], string][]): HTMLElement {
  const list = element("dl", { class: "keys" });
  for (const [keys, what] of IS_TOUCH ? touch : entries) {
    const names = keys.flatMap((key) => [" ", element("kbd", {}, key)]);
    list.append(element("div", {}, element("dt", {}, ...names), element("dd", {}, what)));
  }
  return element("section", { class: "sheet", "aria-label": IS_TOUCH ? "Touch controls" : "Keys", hidden: "" }, list);
}
