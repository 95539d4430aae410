// Status line of the page while the creature of a live session is prepared.

import { element } from "./dom";
import { preparationText, type LiveSource, type News } from "./frame_source";
import { keepStill } from "./still";
import type { Viewer } from "./viewer";

export class Preparation {
  readonly element = element("p", { class: "dock status", role: "status", "aria-live": "polite" });

  constructor(
    source: LiveSource,
    private readonly viewer: Viewer,
  ) {
    source.listen((news) => this.handleNews(news));
  }

  private handleNews(news: News): void {
    if (news.type === "ready") {
      keepStill(this.viewer.picture());
      location.reload();
    } else if (news.type === "preparing") {
      this.element.textContent = preparationText(news.stage);
    } else if (news.type === "failed") {
      this.element.textContent = news.text;
      this.element.classList.add("wrong");
    }
  }
}
