// Adjustment of a camera to its window: field of view, depth range, and the panels that cover a part of the picture.

import type * as THREE from "three";

/** Minimum width of a panel, as a fraction of the picture, at which the picture is moved clear of the panel. */
const MIN_PANEL_WIDTH = 0.5;
/** Maximum fraction of the height of the picture that is considered covered. */
const MAX_COVERED = 0.6;
/** Distance between a panel and the uncovered part, pixels. */
const GAP = 6;

/** Heights of the parts at the top and at the bottom of a picture that panels cover, pixels. */
export interface Margins {
  top: number;
  bottom: number;
}

/** Size of a picture and the part of it that panels cover, pixels. */
export interface Frame extends Margins {
  width: number;
  height: number;
}

/** Return the margins of `picture` that wide visible `panels` on it cover. */
export function marginsOf(picture: Element, panels: Iterable<Element>): Margins {
  const box = picture.getBoundingClientRect();
  let [top, bottom] = [0, 0];
  for (const panel of panels) {
    const cover = panel.getBoundingClientRect();
    const width = Math.min(cover.right, box.right) - Math.max(cover.left, box.left);
    const isOutside = cover.height === 0 || cover.bottom <= box.top || cover.top >= box.bottom;
    if (isOutside || width < MIN_PANEL_WIDTH * box.width) continue;
    if (cover.top + cover.bottom > box.top + box.bottom) bottom = Math.max(bottom, box.bottom - cover.top + GAP);
    else top = Math.max(top, cover.bottom - box.top + GAP);
  }
  const scale = Math.min(1, (MAX_COVERED * box.height) / Math.max(top + bottom, 1));
  return { top: scale * top, bottom: scale * bottom };
}

/** Set the projection such that the uncovered part of the picture shows what a square film with the field of view `fov`
 * (degrees) shows, in its middle; and set the depth range for a body of `bodyHeight`. In a part that is higher than
 * wide, the film is enlarged by up to `portraitZoom`, so that its sides are cut off. */
export function fitCamera(
  camera: THREE.PerspectiveCamera,
  fov: number,
  frame: Frame,
  bodyHeight: number,
  portraitZoom = 1,
): void {
  const { width, height, top, bottom } = frame;
  const half = (Math.tan((Math.PI * fov) / 360) * height) / Math.min(portraitZoom * width, height - top - bottom);
  camera.fov = (360 / Math.PI) * Math.atan(half);
  camera.aspect = width / height;
  camera.near = 0.02 * bodyHeight;
  camera.far = 400 * bodyHeight;
  camera.setViewOffset(width, height, 0, 0.5 * (bottom - top), width, height);
}
