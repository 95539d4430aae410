// Controls of playback: play, time line, clock, speed.

import { button, element, icon } from "./dom";
import type { Player } from "./player";

interface BarOptions {
  speeds: readonly number[];
  /** Function that is called when the user presses the play button. */
  onToggle: () => void;
  /** Function that is called when the user moves the time line. */
  onSeek?: () => void;
  /** True if the bar has a button that switches the loop. */
  hasLoop?: boolean;
}

/** Bar that shows and controls a player. The owner of the bar calls `update` when the player has changed. */
export class PlaybackBar {
  readonly element: HTMLElement;
  private readonly playButton: HTMLButtonElement;
  private readonly slider = element("input", {
    ...{ type: "range", min: "0", step: "any", class: "line", "aria-label": "Time", title: "Time" },
  });
  private readonly clock = element("span", { class: "clock", role: "timer", title: "Time and duration" });
  private readonly speed = element("select", { class: "speed", "aria-label": "Speed", title: "Speed" });
  private readonly loopButton: HTMLButtonElement;

  constructor(
    private readonly player: Player,
    { speeds, onToggle, onSeek, hasLoop = false }: BarOptions,
  ) {
    this.playButton = button("play", "Play (space)", onToggle);
    this.playButton.classList.add("play");
    this.slider.addEventListener("input", () => {
      player.seek(Number(this.slider.value));
      onSeek?.();
    });
    for (const value of speeds) this.addSpeed(value);
    this.speed.addEventListener("change", () => {
      player.speed = Number(this.speed.value);
    });
    this.loopButton = button("loop", "Loop (l)", () => this.toggleLoop());
    this.loopButton.id = "loop";
    this.element = element("footer", { class: "dock" }, this.playButton, this.slider, this.clock, this.speed);
    if (hasLoop) this.element.append(this.loopButton);
  }

  toggleLoop(): void {
    this.player.loop = !this.player.loop;
    this.update();
  }

  update(): void {
    const { player } = this;
    const done = player.framePosition / Math.max(player.lastFrame, 1);
    this.slider.max = String(player.lastFrame);
    this.slider.value = String(player.framePosition);
    this.slider.style.setProperty("--done", `${100 * done}%`);
    this.slider.setAttribute("aria-valuetext", `${player.seconds.toFixed(2)} s`);
    this.clock.textContent = `${player.seconds.toFixed(2)} / ${(player.lastFrame / player.rate).toFixed(2)} s`;
    const speed = String(player.speed);
    if (![...this.speed.options].some(({ value }) => value === speed)) this.addSpeed(player.speed);
    this.speed.value = speed;
    this.loopButton.setAttribute("aria-pressed", String(player.loop));
    const action = player.playing ? "Pause (space)" : "Play (space)";
    if (this.playButton.title === action) return;
    this.playButton.innerHTML = icon(player.playing ? "pause" : "play");
    this.playButton.title = action;
    this.playButton.setAttribute("aria-label", action);
  }

  private addSpeed(value: number): void {
    this.speed.append(new Option(`${value}\u00d7`, String(value)));
  }
}
