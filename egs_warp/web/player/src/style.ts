// Style sheet of the element, in its shadow tree. A page may set the custom properties on the element.

import CONTROLS from "../../client/src/controls.css";

export const STYLE = /* css */ `
${CONTROLS}
:host {
  display: block; position: relative; aspect-ratio: 1; overflow: hidden; background: var(--egs-ground, var(--ground));
  color: var(--text); container-type: inline-size;
}
:host([hidden]) { display: none; }
:host([background]) { background: none; }
.frame, canvas, img { position: absolute; inset: 0; width: 100%; height: 100%; display: block; }
canvas { touch-action: pan-y; cursor: grab; }
canvas:active { cursor: grabbing; }
img { object-fit: cover; pointer-events: none; }
.dock { left: 8px; right: 8px; bottom: 8px; gap: 6px; padding: 2px 6px 2px 3px; max-width: 760px; }
.icon { width: 40px; height: 40px; color: inherit; }
.start {
  position: absolute; left: 50%; top: 50%; translate: -50% -50%; width: 64px; height: 64px; border-radius: 50%;
  background: var(--pane); border: 1px solid var(--line);
}
.start:hover { background: var(--menu); }
.speed { appearance: none; padding: 10px 6px; text-align: right; }
.line { height: 40px; }
.message {
  position: absolute; left: 50%; top: 50%; translate: -50% -50%; margin: 0; padding: 10px 16px; width: max-content;
  max-width: calc(100% - 24px); border-radius: 11px; background: var(--pane); border: 1px solid var(--line);
}
@container (max-width: 340px) { .clock { display: none; } }
@container (max-width: 260px) { .speed { display: none; } }
`;
