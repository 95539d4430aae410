// Panel with a button for each motion that needs no file, and one that saves the performed motions.

import { button, element } from "./dom";

/** Create the hidden panel; `onChoose` gets the name of a motion, `onSave` is called when the script is saved. */
export function createMotionPanel(
  names: readonly string[],
  onChoose: (name: string) => void,
  onSave: () => void,
): HTMLElement {
  const grid = element("div", { class: "motions", role: "group", "aria-label": "Motions", title: "Perform it next" });
  for (const name of names) {
    const choice = element("button", { type: "button" }, name);
    choice.addEventListener("click", (event) => {
      onChoose(name);
      // Return the keyboard focus to the page.
      if (event.detail > 0) choice.blur();
    });
    grid.append(choice);
  }
  const save = button("script", "Save the performed motions as a script", onSave);
  const row = element("label", { class: "save" }, save, "Save the performed motions");
  return element("section", { class: "sheet", "aria-label": "Motions", hidden: "" }, grid, row);
}
