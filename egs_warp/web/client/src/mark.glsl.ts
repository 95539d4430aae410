// Colours of splats that depend on the picked object, or on the selected body, to which they belong.

export const MARK_GLSL = /* glsl */ `
/* Colour of a splat with the unmarked colour c: bright if the splat belongs to the object with the number lit, darker
   if it belongs to another object, and dim if it belongs to none. Colours do not change while lit is negative. If lit
   is at least 256, the splats of the selected body lit - 256 are brightened, and all others keep their colours. */
vec3 egsMarked(vec3 c, sampler2D marks, int index, int lit) {
  if (lit < 0) return c;
  int label = int(egsTexel(marks, index).r * 255.0 + 0.5);
  if (lit >= 256) return label == lit - 256 ? min(1.08 * c + 0.1 * vec3(0.5, 0.82, 0.72), vec3(1.0)) : c;
  float grey = dot(c, vec3(0.3, 0.6, 0.1));
  if (label == 0) return 0.42 * mix(vec3(grey), c, 0.45);
  if (label != lit) return 0.55 * c + 0.16 * vec3(1.0, 0.76, 0.29);
  return min(1.06 * c + 0.07 * vec3(0.5, 0.82, 0.72), vec3(1.0));
}
`;
