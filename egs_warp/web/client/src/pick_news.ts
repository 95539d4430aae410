// Events of the session of egs-warp pick (egs_warp/web/pick_session.py).

import type { FilmCamera } from "./packets";

export type Vector = [number, number, number];

/** The objects, and the ground and front of the active one; lengths in the frame of the page. */
export interface PickState {
  type: "pick";
  objects: { name: string; count: number }[];
  active: number;
  /** Unit normal and offset of the ground n.x + d = 0. */
  plane: [number, number, number, number];
  /** Point of the ground under the object. */
  anchor: Vector;
  /** Diagonal of the object. */
  size: number;
  /** Front that the user has set; null if there is none. */
  front: Vector | null;
  undo: boolean;
  redo: boolean;
  warnings: string[];
  /** True if the object is a guess. */
  proposal: boolean;
}

/** Measured properties of the active object. */
export interface BodyNews {
  type: "body";
  measuring?: boolean;
  rows: [string, string][];
  /** Motions; each motion that the object cannot perform has a reason. */
  motions: { name: string; why: string | null }[];
  /** Given or estimated front. */
  front: Vector | null;
}

/** Uneven ground around the active object: heights over the plane at the nodes of a square grid, row by row. */
export interface GroundGrid {
  /** First node, on the plane. */
  origin: Vector;
  /** Unit vectors along the rows and along the columns. */
  first: Vector;
  second: Vector;
  spacing: number;
  /** Number of columns and of rows. */
  count: number;
  heights: number[];
}

/** Progress of a command that the page has started. Such a command may serve a page of its own. */
export interface JobNews {
  type: "animate" | "live";
  text: string;
  running: boolean;
  failed: boolean;
  address?: string;
}

export type PickNews =
  | PickState
  | BodyNews
  | JobNews
  | {
      type: "view";
      /** Camera that shows the proposal. */
      camera: FilmCamera;
    }
  | { type: "ground"; grid: GroundGrid | null }
  | { type: "labels"; data: string }
  | { type: "work"; text: string };
