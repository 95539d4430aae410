// Panel with a button for each motion that needs no file, and one that saves the performed motions.

import { button, element } from "./dom";

export class MotionPanel {
  readonly element: HTMLElement;
  private readonly choices = new Map<string, HTMLButtonElement>();

  /** Create the hidden panel.
   *
   * `onChoose` gets the name of a motion, also of a grey one, because the session decides whether the body can perform
   * it; `onSave` is called when the script is saved. */
  constructor(
    names: readonly string[],
    onChoose: (name: string) => void,
    onSave: () => void,
  ) {
    const grid = element("div", { class: "motions", role: "group", "aria-label": "Motions" });
    for (const name of names) {
      const choice = element("button", { type: "button" }, name);
      choice.addEventListener("click", (event) => {
        onChoose(name);
        // Return the keyboard focus to the page.
        if (event.detail > 0) choice.blur();
      });
      this.choices.set(name, choice);
      grid.append(choice);
    }
    const save = button("script", "Save the performed motions as a script", onSave);
    const row = element("label", { class: "save" }, save, "Save the performed motions");
    this.element = element("section", { class: "sheet", "aria-label": "Motions", hidden: "" }, grid, row);
    this.showRefusals({});
  }

  /** Grey out the motions that the body cannot perform at the start; `refusals` are their reasons by name. */
  showRefusals(refusals: Record<string, string>): void {
    for (const [name, choice] of this.choices) {
      const reason = refusals[name];
      choice.title = reason ?? "Perform it next";
      choice.classList.toggle("refused", reason !== undefined);
    }
  }
}
