// Builds page.html, a single file with script and style, which the package ships, serves and exports.
import { readFile, writeFile } from "node:fs/promises";
import { build } from "esbuild";

const result = await build({
  entryPoints: ["src/main.ts"],
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  write: false,
  outdir: "out",
  alias: { "@sparkjsdev/spark": "./node_modules/@sparkjsdev/spark/dist/spark.module.min.js" },
  legalComments: "inline",
});
const text = (ending) => result.outputFiles.find((file) => file.path.endsWith(ending)).text;
// The licences require their text to accompany the code.
const licences = await Promise.all(
  ["three", "@sparkjsdev/spark", "fflate", "mediabunny"].map(
    async (name) => `${name}\n\n${await readFile(`node_modules/${name}/LICENSE`, "utf8")}`,
  ),
);
const shell = await readFile("src/index.html", "utf8");
// Replacements are functions, because the bundle contains "$&".
const page = shell
  .replace("<!-- licences -->", () => `<!--\n${licences.join("\n\n").replaceAll("--", "- -")}\n-->`)
  .replace("/* style */", () => text(".css"))
  .replace("/* script */", () => text(".js").replaceAll("</script", "<\\/script"));
await writeFile("../page.html", page);
console.log(`page.html: ${(page.length / 1e6).toFixed(2)} MB`);
