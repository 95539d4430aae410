// Page of a live session while its creature is prepared: it shows the still capture, the stage of the preparation, and
// the front of the body as soon as it is known.

import { viewOf, type Orbit } from "./camera_turn";
import { listenToClicks } from "./clicks";
import { element } from "./dom";
import { earlyKeys } from "./early_keys";
import type { LiveSource, News } from "./frame_source";
import { preparationText } from "./preparation_text";
import { reloadWith } from "./reload";
import type { Viewer } from "./viewer";

/** Time for which the page says that the camera turns to the front, ms. */
const FRONT_TIME = 4000;

type Preparing = Extract<News, { type: "preparing" }>;

export class Preparation {
  readonly element = element("div", { class: "dock status", role: "status", "aria-live": "polite" });
  private readonly stage = element("p", {});
  private readonly detail = element("p", { class: "detail-line" });
  private camera: Preparing["camera"];

  constructor(
    source: LiveSource,
    private readonly viewer: Viewer,
  ) {
    this.element.append(this.stage, this.detail);
    this.camera = source.header.facts.camera;
    earlyKeys.start();
    listenToClicks(viewer.canvas, () => earlyKeys.refuse());
    source.listen((news) => this.handleNews(news));
  }

  private handleNews(news: News): void {
    if (news.type === "ready") this.finish();
    else if (news.type === "preparing") {
      this.stage.textContent = preparationText(news.stage);
      this.detail.textContent = news.note ?? "";
      if (news.camera !== undefined) this.turnTo(news.camera);
    } else if (news.type === "failed") {
      this.stage.textContent = news.text;
      this.detail.textContent = "";
      this.element.classList.add("wrong");
      earlyKeys.stop();
    }
  }

  /** Turn the camera to the front of the body, unless the user has chosen another view. */
  private turnTo(camera: NonNullable<Preparing["camera"]>): void {
    if (this.camera?.position.join() === camera.position.join()) return;
    this.camera = camera;
    const { turn } = this.viewer;
    const effect = turn.isMovedByUser ? "your view stays" : "the camera turns to it";
    this.element.append(this.note(`its front is found; ${effect}`));
    if (!turn.isMovedByUser) this.viewer.turnTo(camera);
  }

  private note(text: string): HTMLElement {
    const note = element("p", { class: "detail-line" }, text);
    setTimeout(() => note.remove(), FRONT_TIME);
    return note;
  }

  /** Show the creature when the camera has stopped; in a hidden tab, it does not move. */
  private finish(): void {
    if (this.viewer.turn.isActive && !document.hidden) {
      setTimeout(() => this.finish(), 50);
      return;
    }
    reloadWith({ view: this.view(), picture: this.viewer.picture(), action: () => earlyKeys.action });
  }

  /** Return the view that the user has chosen, relative to the camera of the film. */
  private view(): Orbit | undefined {
    if (!this.viewer.turn.isMovedByUser || this.camera === undefined) return undefined;
    const { camera, controls, height } = this.viewer;
    return viewOf(camera.position.clone().sub(controls.target), this.camera.forward, height);
  }
}
