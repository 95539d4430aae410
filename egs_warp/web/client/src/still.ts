// Picture of the page that is shown while the page reloads, until its first image has been drawn.

import { element } from "./dom";

const KEY = "egs-still";
/** Time after which the picture is removed even if nothing is drawn, ms. */
const MAX_TIME = 20000;
/** Duration of the transition from the picture to the page, ms. */
const FADE_TIME = 400;

/** Store `picture`, the data URL of an image, for the next page of this tab. */
export function keepStill(picture: string): void {
  try {
    sessionStorage.setItem(KEY, picture);
  } catch {
    // Without storage, or if the picture is too large for it, the page is blank while it loads.
  }
}

/** Return the stored picture and remove it from the storage. */
function takeStill(): string | null {
  try {
    const picture = sessionStorage.getItem(KEY);
    sessionStorage.removeItem(KEY);
    return picture;
  } catch {
    // A page in a sandboxed frame has no storage.
    return null;
  }
}

/** Show the picture of the previous page of this tab, if there is one; the returned function fades it out. */
export function showStill(): () => void {
  const picture = takeStill();
  if (picture === null) return () => {};
  const image = element("img", { class: "still", src: picture, alt: "" });
  document.body.append(image);
  const fade = (): void => {
    image.classList.add("gone");
    setTimeout(() => image.remove(), FADE_TIME);
  };
  setTimeout(fade, MAX_TIME);
  return fade;
}
