// Entry point of the package for programs with their own three.js scene; they provide three.js and Spark.

export { loadBundle, readBundle, type Bundle, type BundleBody, type BundleCage, type Facts } from "./bundle";
export { addCreature, Creature } from "./creature";
