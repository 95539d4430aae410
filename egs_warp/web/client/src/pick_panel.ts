// Panel of the page of egs-warp pick: the objects; size, feet and motions of the active object; and the commands.

import { button, element } from "./dom";
import type { BodyNews, JobNews, PickState } from "./pick_news";

type Send = (message: Record<string, unknown>) => void;

export class PickPanel {
  readonly element: HTMLElement;
  private readonly objects = element("div", { class: "objects" });
  private readonly hints = element("div", { class: "hints" });
  private readonly rows = element("dl", { class: "facts" });
  private readonly impossible = element(
    "details",
    {},
    element("summary", { title: "Motions that this body cannot perform, and why" }, "motions that are not possible"),
    element("dl", { class: "facts" }),
  );
  private readonly motion = element("select", { class: "motion", "aria-label": "Motion", title: "Motion" });
  private readonly jobs = { animate: element("p", { class: "job" }), live: element("p", { class: "job" }) };
  private readonly actions: HTMLButtonElement[];

  constructor(private readonly send: Send) {
    const action = (id: string, name: string, title: string, onClick: () => void): HTMLButtonElement => {
      const created = element("button", { type: "button", class: "action", id, title }, name);
      created.addEventListener("click", onClick);
      return created;
    };
    this.motion.append(element("option", { value: "jump" }, "jump"));
    this.actions = [
      action("animate", "Animate", "Film the chosen motion", () => {
        send({ type: "animate", motion: this.motion.value });
      }),
      action("live", "Live", "Control this object in the browser", () => send({ type: "live" })),
    ];
    const [animate, live] = this.actions as [HTMLButtonElement, HTMLButtonElement];
    const add = button("object", "Another object (n)", () => send({ type: "add" }));
    const remove = button("bin", "Remove this object", () => send({ type: "remove" }));
    this.element = element(
      "section",
      { class: "panel", "aria-label": "Objects and motions" },
      element("header", {}, this.objects, add, remove),
      this.hints,
      this.rows,
      this.impossible,
      element("div", { class: "run" }, this.motion, animate, live),
      this.jobs.animate,
      this.jobs.live,
    );
    this.impossible.hidden = true;
  }

  /** Show or hide the panel in a narrow window. */
  toggle(): void {
    this.element.classList.toggle("shown");
  }

  showObjects(state: PickState): void {
    this.objects.replaceChildren(
      ...state.objects.map(({ name, count }, index) => {
        const chip = element("button", { type: "button", class: "chip", title: `Select ${name}` });
        chip.append(element("span", {}, name));
        chip.append(element("small", {}, count === 0 ? "empty" : count.toLocaleString("en")));
        chip.setAttribute("aria-pressed", String(index === state.active));
        chip.addEventListener("click", () => this.send({ type: "select", index }));
        return chip;
      }),
    );
    const isEmpty = state.objects[state.active]?.count === 0;
    const hints = [...state.warnings];
    if (isEmpty) hints.push("click on the object");
    else if (state.proposal) hints.push("this is a guess: click on another object if it is wrong");
    this.hints.replaceChildren(...hints.map((text) => element("p", {}, text)));
    for (const one of this.actions) one.disabled = isEmpty;
    this.rows.replaceChildren();
    this.impossible.hidden = true;
  }

  showBody(body: BodyNews): void {
    const rows: [string, string][] = body.measuring ? [["body", "measuring\u2026"]] : body.rows;
    const possible = body.motions.filter(({ why }) => why === null);
    if (possible.length > 0) rows.push(["can", possible.map(({ name }) => name).join(", ")]);
    fill(this.rows, rows);
    const others = body.motions.filter(({ why }) => why !== null);
    this.impossible.hidden = others.length === 0;
    const count = others.length === 1 ? "1 motion is" : `${others.length} motions are`;
    (this.impossible.firstElementChild as HTMLElement).textContent = `${count} not possible`;
    fill(this.impossible.lastElementChild as HTMLElement, others.map(({ name, why }) => [name, why ?? ""]));
    if (possible.length === 0) return;
    const chosen = this.motion.value;
    this.motion.replaceChildren(...possible.map(({ name }) => element("option", { value: name }, name)));
    if (possible.some(({ name }) => name === chosen)) this.motion.value = chosen;
  }

  showJob({ type, text, failed, running, address }: JobNews): void {
    const line = this.jobs[type];
    const title = type === "animate" ? "Film" : "Live";
    line.classList.toggle("wrong", failed);
    line.replaceChildren(`${title}: `, running && address === undefined ? `${text}\u2026` : text);
    if (address === undefined) return;
    const name = type === "animate" ? "show the film in 3D" : "open the live page";
    line.append(" ", element("a", { href: address, title: name, target: "_blank", rel: "noreferrer" }, name));
  }
}

/** Fill a list of names and values. */
function fill(list: HTMLElement, rows: [string, string][]): void {
  list.replaceChildren(...rows.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
}
