// Builds the two entry points of the package: egs-player.js, a single file for pages, and three.js for three.js scenes.
import { copyFile, readFile, writeFile } from "node:fs/promises";
import { build } from "esbuild";

const shared = { bundle: true, minify: true, format: "esm", target: "es2022", legalComments: "inline", loader: { ".css": "text" } };
const modules = (name) => `./node_modules/${name}`;
/** Resolves packages from this folder, also for the sources that are shared with the page. */
const ownPackages = {
  name: "own packages",
  setup({ onResolve, resolve }) {
    onResolve({ filter: /^three(\/|$)/ }, ({ path, kind, pluginData }) =>
      pluginData === "own" ? undefined : resolve(path, { resolveDir: process.cwd(), kind, pluginData: "own" }),
    );
  },
};
const page = await build({
  ...shared,
  entryPoints: ["src/index.ts"],
  alias: { "@sparkjsdev/spark": modules("@sparkjsdev/spark/dist/spark.module.min.js") },
  plugins: [ownPackages],
  write: false,
});
// The licences require their text to accompany the code.
const licences = await Promise.all(
  ["three", "@sparkjsdev/spark", "fflate"].map(
    async (name) => `${name}\n\n${await readFile(modules(`${name}/LICENSE`), "utf8")}`,
  ),
);
const code = page.outputFiles[0].text;
await writeFile("dist/egs-player.js", `/*!\n${licences.join("\n\n").replaceAll("*/", "* /")}\n*/\n${code}`);
await build({
  ...shared,
  entryPoints: ["src/three.ts"],
  external: ["three", "@sparkjsdev/spark"],
  outfile: "dist/three.js",
});
await copyFile("../../../LICENSE", "dist/LICENSE");
console.log(`egs-player.js: ${(code.length / 1e6).toFixed(2)} MB`);
