// Entry point of the package for pages: defines <egs-player> and includes three.js and Spark.

import { EgsPlayer } from "./element";

if (customElements.get("egs-player") === undefined) customElements.define("egs-player", EgsPlayer);

declare global {
  interface HTMLElementTagNameMap {
    "egs-player": EgsPlayer;
  }
}

export { EgsPlayer } from "./element";
export { loadBundle, readBundle } from "./bundle";
