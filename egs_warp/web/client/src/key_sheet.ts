// Sheet that lists the keys and the uses of the pointer.

import { element } from "./dom";

/** Create a hidden sheet; each entry has the keys or gestures and what they do. */
export function createKeySheet(entries: [string[], string][]): HTMLElement {
  const list = element("dl", { class: "keys" });
  for (const [keys, what] of entries) {
    const names = keys.flatMap((key) => [" ", element("kbd", {}, key)]);
    list.append(element("dt", {}, ...names), element("dd", {}, what));
  }
  return element("section", { class: "sheet", "aria-label": "Keys", hidden: "" }, list);
}
