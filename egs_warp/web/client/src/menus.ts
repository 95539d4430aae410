// Menus of the tools: they close on Escape and when the user presses elsewhere.

/** Hide the menus in `root`; return true if one was shown. */
export function closeMenus(root: HTMLElement): boolean {
  const shown = [...root.querySelectorAll<HTMLElement>(".menu:not([hidden])")];
  for (const menu of shown) menu.hidden = true;
  return shown.length > 0;
}

/** Hide a menu when the user presses elsewhere. A control of a menu that was clicked does not keep the keyboard. */
export function closeMenusOutside(root: HTMLElement): void {
  const tools = root.querySelector(".tools");
  const press = ({ target }: PointerEvent): void => {
    if (!(target instanceof Node && tools?.contains(target))) closeMenus(root);
  };
  document.addEventListener("pointerdown", press, { capture: true });
  for (const menu of root.querySelectorAll<HTMLElement>(".menu")) {
    menu.addEventListener("click", ({ detail }) => {
      if (detail > 0 && document.activeElement instanceof HTMLElement) document.activeElement.blur();
    });
  }
}
