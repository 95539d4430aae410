// Small charts of the audit's curves, with a marker at the current frame.

import { element } from "./dom";
import type { FrameSource } from "./frame_source";

/** Number of colours for curves in style.css. */
const COLOURS = 5;

export class Charts {
  readonly panel = element("section", { class: "curves", "aria-label": "Curves of the audit" });
  private readonly rows: { row: HTMLElement; canvas: HTMLCanvasElement; value: HTMLElement }[] = [];
  /** Index of the body of a world whose curves are shown. */
  private body = 0;

  constructor(
    private readonly source: FrameSource,
    seek: (framePosition: number) => void,
  ) {
    for (const { title, unit } of source.header.facts.curves) {
      const hint = `${title}; click to go to that time`;
      const canvas = element("canvas", { class: "curve", role: "img", "aria-label": hint, title: hint });
      const value = element("span", { class: "value" });
      const row = element(
        "div",
        { class: "row" },
        element("span", { class: "label" }, title, " ", element("small", {}, unit)),
        value,
        canvas,
      );
      canvas.addEventListener("pointerdown", (event) => {
        const box = canvas.getBoundingClientRect();
        seek(((event.clientX - box.left) / box.width) * (source.frames.length - 1));
      });
      this.panel.append(row);
      this.rows.push({ row, canvas, value });
    }
    this.select(0);
  }

  /** Show the curves of a body of a world. */
  select(body: number): void {
    this.body = body;
    this.source.header.facts.curves.forEach((curve, k) => {
      this.rows[k]!.row.hidden = curve.body !== undefined && curve.body !== body;
    });
  }

  draw(framePosition: number): void {
    if (this.panel.hidden) return;
    const { frames } = this.source;
    const now = frames[Math.min(Math.round(framePosition), frames.length - 1)];
    const style = getComputedStyle(this.panel);
    const { curves } = this.source.header.facts;
    this.rows.forEach(({ canvas, value }, k) => {
      const { body } = curves[k]!;
      if (body !== undefined && body !== this.body) return;
      const values = frames.map((frame) => frame.curves[k] ?? 0);
      value.textContent = formatted(now?.curves[k] ?? 0);
      const colour = style.getPropertyValue(`--curve-${k % COLOURS}`);
      plot(canvas, values, framePosition / Math.max(frames.length - 1, 1), colour, style.color);
    });
  }
}

function formatted(value: number): string {
  const size = Math.abs(value);
  if (size !== 0 && size < 1e-3) return value.toExponential(0);
  return value.toFixed(size < 10 ? 2 : 0).replace(/^-(0\.00)$/, "$1");
}

function plot(canvas: HTMLCanvasElement, values: number[], fraction: number, colour: string, axis: string): void {
  const ratio = Math.min(window.devicePixelRatio, 2);
  const [width, height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio];
  if (width === 0) return;
  canvas.width = width;
  canvas.height = height;
  const context = canvas.getContext("2d");
  if (context === null) return;
  const low = Math.min(0, ...values);
  const high = Math.max(...values, low + 1e-12);
  const x = (k: number): number => (k / Math.max(values.length - 1, 1)) * width;
  const y = (value: number): number => height - 2 * ratio - ((value - low) / (high - low)) * (height - 4 * ratio);
  context.strokeStyle = axis;
  context.globalAlpha = 0.15;
  context.lineWidth = ratio;
  context.beginPath();
  context.moveTo(0, y(0));
  context.lineTo(width, y(0));
  context.stroke();
  context.globalAlpha = 1;
  const trace = (): void => {
    context.beginPath();
    values.forEach((value, k) => context.lineTo(x(k), y(value)));
    context.stroke();
  };
  context.lineJoin = "round";
  context.lineWidth = 1.4 * ratio;
  context.strokeStyle = colour;
  context.globalAlpha = 0.3;
  trace();
  context.globalAlpha = 1;
  context.save();
  context.beginPath();
  context.rect(0, 0, fraction * width, height);
  context.clip();
  trace();
  context.restore();
  context.fillStyle = colour;
  context.fillRect(fraction * width - 0.5 * ratio, 0, ratio, height);
}
