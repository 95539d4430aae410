// Helpers that create elements, icons and downloads.

export function element<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Record<string, string> = {},
  ...children: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const created = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) created.setAttribute(name, value);
  created.append(...children);
  return created;
}

/** Draw two letters inside the outline of glasses. */
function letters(text: string): string {
  return (
    '<path d="M5 5.5h14a3 3 0 0 1 3 3v7a3 3 0 0 1-3 3h-4.5L12 16l-2.5 2.5H5a3 3 0 0 1-3-3v-7a3 3 0 0 1 3-3z"/>' +
    `<text x="12" y="14.2" font-size="8.5" font-weight="700" text-anchor="middle" fill="currentColor" ` +
    `stroke="none">${text}</text>`
  );
}

const ICONS = {
  play: '<path d="M7 4.5v15l12-7.5z" fill="currentColor" stroke="none"/>',
  pause: '<path d="M7 5h3.5v14H7zM13.5 5H17v14h-3.5z" fill="currentColor" stroke="none"/>',
  loop: '<path d="M17 3l3 3-3 3M4 11V9a3 3 0 0 1 3-3h13M7 21l-3-3 3-3M20 13v2a3 3 0 0 1-3 3H4"/>',
  layers: '<path d="M12 3l9 5-9 5-9-5zM3 12.5l9 5 9-5M3 17l9 5 9-5" stroke-linejoin="round"/>',
  camera: '<path d="M4 8h3l2-3h6l2 3h3v11H4z" stroke-linejoin="round"/><circle cx="12" cy="13" r="3.4"/>',
  view: '<path d="M12 3l8 4.5v9L12 21l-8-4.5v-9zM12 12l8-4.5M12 12v9M12 12L4 7.5" stroke-linejoin="round"/>',
  record: '<circle cx="12" cy="12" r="8.5"/><circle cx="12" cy="12" r="4" fill="currentColor" stroke="none"/>',
  step: '<path d="M5 4.5v15l10-7.5z" fill="currentColor" stroke="none"/><path d="M18.5 5v14" stroke-width="2.4"/>',
  forward: '<path d="M12 20V5M6 10.5L12 4.5l6 6" stroke-linejoin="round"/>',
  left: '<path d="M9 4L4.5 8.5 9 13M5 8.5h8a6 6 0 0 1 0 12H9" stroke-linejoin="round"/>',
  right: '<path d="M15 4l4.5 4.5L15 13M19 8.5h-8a6 6 0 0 0 0 12h4" stroke-linejoin="round"/>',
  jump: '<path d="M5 20h14M12 16V4M7.5 8.5L12 4l4.5 4.5" stroke-linejoin="round"/>',
  push: '<path d="M3 12h11M9.5 7.5L14 12l-4.5 4.5M19 4.5v15" stroke-linejoin="round"/>',
  leap: '<path d="M4 19c2-14 13-16 16-3M16.5 13.5L20 16.5l1.5-4.5" stroke-linejoin="round"/>',
  sliders:
    '<path d="M4 7h9M18 7h2M4 17h2M11 17h9"/><circle cx="15.5" cy="7" r="2.3"/><circle cx="8.5" cy="17" r="2.3"/>',
  motions: '<path d="M4 6h14M4 12h7M4 18h7"/><path d="M14.5 10.5v9l7-4.5z" fill="currentColor" stroke="none"/>',
  script: '<path d="M6 3.5h9l4 4V20.5H6zM9.5 11h6M9.5 14.5h6" stroke-linejoin="round"/>',
  stand:
    '<path d="M12 21V9M8 21h8"/><circle cx="12" cy="5.5" r="2.5"/><path d="M7 13l5-3 5 3" stroke-linejoin="round"/>',
  help:
    '<circle cx="12" cy="12" r="8.5"/>' +
    '<path d="M9.5 9.5a2.5 2.5 0 1 1 3.5 2.3c-.7.3-1 .8-1 1.7M12 16.5v.01" stroke-linecap="round"/>',
  vr: letters("VR"),
  ar: letters("AR"),
  plus: '<circle cx="12" cy="12" r="8.5"/><path d="M12 8v8M8 12h8"/>',
  minus: '<circle cx="12" cy="12" r="8.5"/><path d="M8 12h8"/>',
  brush: '<path d="M4 20c4 0 5-1.5 5-4l9-11 2 2-11 9c-2.5 0-3 2-5 4z" stroke-linejoin="round"/>',
  undo: '<path d="M8 4L3.5 8.5 8 13M4 8.5h10a5.5 5.5 0 0 1 0 11H9" stroke-linejoin="round"/>',
  redo: '<path d="M16 4l4.5 4.5L16 13M20 8.5H10a5.5 5.5 0 0 0 0 11h5" stroke-linejoin="round"/>',
  object: '<path d="M12 3l8 4.5v9L12 21l-8-4.5v-9z" stroke-linejoin="round"/><path d="M12 9v6M9 12h6"/>',
  save: '<path d="M12 4v11M7 10.5L12 15.5l5-5M4 19.5h16" stroke-linejoin="round"/>',
  bin: '<path d="M5 7h14M9 7V4h6v3M7 7l1 13h8l1-13" stroke-linejoin="round"/>',
  curves: '<path d="M3 20V4M3 20h18M6 15c3 0 3-8 6-8s3 6 9 4"/>',
} as const;

export type Icon = keyof typeof ICONS;

export function icon(name: Icon): string {
  const attributes = 'fill="none" stroke="currentColor" stroke-width="1.6" aria-hidden="true"';
  return `<svg viewBox="0 0 24 24" width="20" height="20" ${attributes}>${ICONS[name]}</svg>`;
}

export function button(name: Icon, title: string, onClick: () => void): HTMLButtonElement {
  const created = element("button", { type: "button", class: "icon", title, "aria-label": title });
  created.innerHTML = icon(name);
  created.addEventListener("click", (event) => {
    onClick();
    // Return the keyboard focus to the page.
    if (event.detail > 0) created.blur();
  });
  return created;
}

/** Add a word that wide windows show below the icon of `button`. */
export function labelled(button: HTMLButtonElement, word: string): HTMLButtonElement {
  button.dataset.label = word;
  return button;
}

/** Button that shows or hides `panel` and hides all other `panels`. Screen readers announce whether it is shown. */
export function opener(
  name: Icon,
  title: string,
  panel: HTMLElement,
  panels: readonly HTMLElement[] = [],
): HTMLButtonElement {
  const created = button(name, title, () => {
    panel.hidden = !panel.hidden;
    for (const other of panels) if (other !== panel) other.hidden = true;
  });
  const update = (): void => created.setAttribute("aria-expanded", String(!panel.hidden));
  update();
  // Keys also show and hide panels.
  new MutationObserver(update).observe(panel, { attributeFilter: ["hidden"] });
  return created;
}

/** Canvas with a 3D view. Its role makes screen readers pass keys on to the page. */
export function viewCanvas(label: string, className = ""): HTMLCanvasElement {
  const canvas = element("canvas", { class: className, tabindex: "0", role: "application", "aria-label": label });
  // A browser also draws the frame of the focus when a key is pressed after a click.
  canvas.addEventListener("focus", () => canvas.classList.toggle("tabbed", canvas.matches(":focus-visible")));
  return canvas;
}

/** Download a blob as a file. */
export function save(blob: Blob, name: string): void {
  const link = element("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
