// Style of the element, in its shadow tree. A page may set the custom properties on the element.

export const STYLE = /* css */ `
:host {
  display: block; position: relative; aspect-ratio: 1; overflow: hidden; background: var(--egs-ground, #b9bec6);
  font: 13px/1.4 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; color: #d9dee8;
  --pane: rgb(24 27 32 / 93%); --line: rgb(255 255 255 / 8%); --faint: #8b94a3;
  --accent: var(--egs-accent, #7fd1b8);
}
:host([hidden]) { display: none; }
:host([background]) { background: none; }
* { box-sizing: border-box; }
[hidden] { display: none !important; }
.frame, canvas, img { position: absolute; inset: 0; width: 100%; height: 100%; display: block; }
canvas { touch-action: pan-y; outline: none; cursor: grab; }
canvas:active { cursor: grabbing; }
canvas:focus-visible { outline: 2px solid var(--accent); outline-offset: -2px; }
img { object-fit: cover; pointer-events: none; }
.bar {
  position: absolute; left: 8px; right: 8px; bottom: 8px; display: flex; align-items: center; gap: 6px;
  padding: 2px 6px 2px 3px; max-width: 760px; margin: 0 auto; background: var(--pane);
  border: 1px solid var(--line); border-radius: 11px;
}
button, select, input { font: inherit; color: inherit; }
button { background: none; border: 0; border-radius: 7px; cursor: pointer; padding: 0; }
button:hover { background: rgb(255 255 255 / 7%); }
:is(button, select, input):focus-visible { outline: 2px solid var(--accent); outline-offset: 1px; }
.icon { display: grid; place-items: center; width: 40px; height: 40px; flex: none; }
.start {
  position: absolute; left: 50%; top: 50%; translate: -50% -50%; width: 64px; height: 64px; border-radius: 50%;
  background: var(--pane); border: 1px solid var(--line);
}
.start:hover { background: rgb(45 50 58 / 95%); }
.clock { color: var(--faint); font-variant-numeric: tabular-nums; white-space: nowrap; }
select {
  appearance: none; background: none; border: 0; color: var(--faint); padding: 10px 6px; cursor: pointer;
  text-align: right;
}
option { background: #1b1f25; color: #d9dee8; }
.line { flex: 1; min-width: 40px; height: 40px; margin: 0; appearance: none; background: none; cursor: pointer; }
.line::-webkit-slider-runnable-track {
  height: 3px; border-radius: 2px;
  background: linear-gradient(to right, var(--accent) var(--done, 0%), rgb(255 255 255 / 16%) 0);
}
.line::-moz-range-track {
  height: 3px; border-radius: 2px;
  background: linear-gradient(to right, var(--accent) var(--done, 0%), rgb(255 255 255 / 16%) 0);
}
.line::-webkit-slider-thumb {
  appearance: none; width: 13px; height: 13px; margin-top: -5px; border-radius: 50%; background: #d9dee8;
}
.line::-moz-range-thumb { width: 13px; height: 13px; border: 0; border-radius: 50%; background: #d9dee8; }
.message {
  position: absolute; left: 50%; top: 50%; translate: -50% -50%; margin: 0; padding: 10px 16px; width: max-content;
  max-width: calc(100% - 24px); border-radius: 11px; background: var(--pane); border: 1px solid var(--line);
}
@container (max-width: 300px) { .clock, select { display: none; } }
:host { container-type: inline-size; }
`;
