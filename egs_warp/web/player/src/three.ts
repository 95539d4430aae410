// Entry point of the package for programs that have a three.js scene; three.js and Spark are theirs.

export { loadBundle, readBundle, type Bundle, type BundleBody, type BundleCage, type Facts } from "./bundle";
export { addCreature, Creature } from "./creature";
