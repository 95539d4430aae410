// What a page passes to the next page of its tab when it reloads itself: a picture that covers the next page until its
// first image has been drawn, the view of a camera that the user has moved, and the motion that the user has requested.

import type { Orbit } from "./camera_turn";
import { element } from "./dom";
import type { Action } from "./input";

const PICTURE = "egs-still";
const VIEW = "egs-view";
const ACTION = "egs-action";
/** Time after which the picture is removed even if nothing is drawn, ms. */
const MAX_TIME = 20000;
/** Duration of the transition from the picture to the page, ms. */
const FADE_TIME = 400;

/** What a page passes on. */
interface Start {
  /** View relative to the camera of the film, with lengths in body heights; undefined for that camera itself. */
  view: Orbit | undefined;
  /** Data URL of an image. */
  picture: string;
  /** Return the motion that starts as soon as the body is ready; it is called when the page is left. */
  action: () => Action | undefined;
}

/** Reload the page and pass on a start. */
export function reloadWith({ view, picture, action }: Start): void {
  if (view !== undefined) store(VIEW, JSON.stringify(view));
  store(PICTURE, picture);
  window.addEventListener("pagehide", () => store(ACTION, action() ?? ""));
  location.reload();
}

/** Return the view that the previous page of this tab has passed on, and remove it. */
export function takeView(): Orbit | undefined {
  const view = take(VIEW);
  return view === null ? undefined : (JSON.parse(view) as Orbit);
}

/** Return the motion that the previous page of this tab has passed on, and remove it; undefined if that page was no
 * page of the preparation. */
export function takeAction(): { action: Action | undefined } | undefined {
  const action = take(ACTION);
  return action === null ? undefined : { action: (action || undefined) as Action | undefined };
}

function store(key: string, text: string): void {
  try {
    sessionStorage.setItem(key, text);
  } catch {
    // Without storage, or if the text is too large for it, the page is blank while it loads.
  }
}

function take(key: string): string | null {
  try {
    const text = sessionStorage.getItem(key);
    sessionStorage.removeItem(key);
    return text;
  } catch {
    // A page in a sandboxed frame has no storage.
    return null;
  }
}

/** Show the picture of the previous page of this tab; return a function that fades it out, or undefined if there is no
 * picture. */
export function showStill(): (() => void) | undefined {
  const picture = take(PICTURE);
  if (picture === null) return undefined;
  const image = element("img", { class: "still", src: picture, alt: "" });
  document.body.append(image);
  const fade = (): void => {
    image.classList.add("gone");
    setTimeout(() => image.remove(), FADE_TIME);
  };
  setTimeout(fade, MAX_TIME);
  return fade;
}
