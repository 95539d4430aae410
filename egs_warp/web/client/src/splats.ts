// Splats that a shader deforms with the cage and that Spark draws: means, covariances F Sigma F^T and rotated colour
// bands (Eq. 14, 15).

import { dyno, SplatGenerator } from "@sparkjsdev/spark";
import * as THREE from "three";
import type { BodyShadows } from "./body_shadows";
import { floatTexture, TEXTURE_WIDTH } from "./cage";
import { DEFORM_GLSL } from "./deform.glsl";
import { MARK_GLSL } from "./mark.glsl";
import { OCCLUSION_GLSL } from "./occlusion.glsl";
import type { Shadows } from "./shadow_map";

/** Splats at rest. */
export interface SplatData {
  means: Float32Array;
  /** Quaternions w, x, y, z. */
  rotations: Float32Array;
  /** Standard deviations. */
  scales: Float32Array;
  opacities: Float32Array;
  /** Colours of SH band 0. */
  colours: Float32Array;
  degree: number;
  /** Coefficients of the SH bands above 0 as bytes, 128 plus a number of steps. For each splat and each coefficient in
   * turn, there are three colours. */
  bands: Uint8Array;
  /** Value of 127 steps of each coefficient. */
  bandScales: Float32Array;
}

/** Deformation data of each splat in a cage (Eq. 14). */
export interface Embedding {
  /** Index t of the tetrahedron of the mean, or -1 - t for a splat that has a row of `arms`. */
  meanTets: Int32Array;
  /** Rows of fifteen numbers: tetrahedra and shares of the six arms, and three smoothing lengths. */
  arms: Float32Array;
  /** Maximum stretch of an arm relative to the stretch of the material at its two ends. */
  maxStretch: number;
}

export interface DeformedSplats {
  generator: SplatGenerator;
  /** Regenerate the splats after the cage has changed. */
  update(): void;
  /** Brighten the splats of an object, and dim splats that belong to no object; only for splats with `hasMarks`. */
  mark(labels: Uint8Array, active: number): void;
}

/** Change of the colours of splats as they rotate in the main light. */
export interface Relighting {
  /** Quadratic form of the irradiance, four rows of four numbers. */
  irradiance: number[][];
  /** Normal of each splat at rest as bytes 128 + 127 n. */
  normals: Uint8Array;
}

interface SplatOptions {
  embedding?: Embedding;
  shadows?: Shadows;
  hasMarks?: boolean;
  relighting?: Relighting | undefined;
  bodyShadows?: BodyShadows | undefined;
}

/** Create splats that are deformed by the maps in `cage` and placed by their `generator`.
 *
 * Without an `embedding` they are static, and all use the first tetrahedron. `shadows` darken the splats near the
 * ground. With `hasMarks`, the colour of a splat depends on the object to which it belongs. With `relighting`, the
 * colour of a splat depends on its normal, which rotates with the cage. `bodyShadows` darken the splats near other
 * bodies of the cage. */
export function deformedSplats(
  data: SplatData,
  cage: THREE.DataTexture,
  { embedding, shadows, hasMarks = false, relighting, bodyShadows }: SplatOptions,
): DeformedSplats {
  const { means, rotations, scales, opacities, colours, degree } = data;
  const count = means.length / 3;
  const splats = floatTexture(4 * count);
  const codes = embedding?.meanTets;
  const armRows = embedding?.arms ?? new Float32Array(0);
  let arm = 0;
  for (let i = 0; i < count; i++) {
    const code = codes?.[i] ?? 0;
    const out = splats.values.subarray(16 * i, 16 * i + 16);
    out.set(means.subarray(3 * i, 3 * i + 3), 0);
    out[3] = code;
    out.set(rotations.subarray(4 * i, 4 * i + 4), 4);
    out.set(scales.subarray(3 * i, 3 * i + 3), 8);
    out[11] = opacities[i] as number;
    out.set(colours.subarray(3 * i, 3 * i + 3), 12);
    out[15] = code < 0 ? arm++ : 0;
  }
  const arms = floatTexture(4 * Math.max(1, arm));
  for (let k = 0; k < arm; k++) arms.values.set(armRows.subarray(15 * k, 15 * k + 15), 16 * k);
  const bandScales = [...data.bandScales, ...new Array<number>(16).fill(0)];
  const eye = new THREE.Vector3();
  const marks = hasMarks ? markTexture(count) : undefined;
  const activeMark = dyno.dynoInt(-1, "egsActiveMark");
  const place = new THREE.Matrix4();
  const uniforms = {
    splats: dyno.dynoSampler2D(splats.texture, "egsSplats"),
    arms: dyno.dynoSampler2D(arms.texture, "egsArms"),
    bands: dyno.dynoSampler2D(bandTexture(data.bands, count, degree), "egsBands"),
    bandScales: dyno.dynoMat4(new THREE.Matrix4().fromArray(bandScales), "egsBandScales"),
    cage: dyno.dynoSampler2D(cage, "egsCage"),
    // Without a shadow its region has size 0 and its texture is not sampled.
    sky: dyno.dynoSampler2D(shadows?.sky.texture ?? cage, "egsSky"),
    skyRegion: dyno.dynoVec4(shadows?.sky.region ?? new THREE.Vector4(), "egsSkyRegion"),
    key: dyno.dynoSampler2D(shadows?.key.texture ?? cage, "egsKey"),
    keyRegion: dyno.dynoVec4(shadows?.key.region ?? new THREE.Vector4(), "egsKeyRegion"),
    keySlope: dyno.dynoVec2(shadows?.key.slope ?? new THREE.Vector2(), "egsKeySlope"),
    eye: dyno.dynoVec3(eye, "egsEye"),
    place: dyno.dynoMat4(place, "egsPlace"),
    normals: dyno.dynoSampler2D(relighting ? normalTexture(relighting.normals) : cage, "egsNormals"),
    // The irradiance is zero without a main light.
    irradiance: dyno.dynoMat4(
      new THREE.Matrix4().fromArray(relighting?.irradiance.flat() ?? new Array<number>(16).fill(0)),
      "egsIrradiance",
    ),
    degree: dyno.dynoConst("int", degree),
    marks: dyno.dynoSampler2D(marks?.texture ?? cage, "egsMarks"),
    activeMark,
    maxStretch: dyno.dynoConst("float", embedding?.maxStretch ?? 1),
  };
  const occluders = bodyShadows && {
    splats: uniforms.splats,
    cage: uniforms.cage,
    place: uniforms.place,
    table: dyno.dynoSampler2D(bodyShadows.table, "egsOccluders"),
    seeds: dyno.dynoSampler2D(bodyShadows.seeds, "egsOccluderSeeds"),
    levels: dyno.dynoSampler2D(bodyShadows.levels, "egsOccluderLevels"),
    up: dyno.dynoVec3(bodyShadows.up, "egsUp"),
  };
  const covGenerator = dyno.dynoBlock({ index: "int" }, { covsplat: dyno.CovSplat }, ({ index }) => {
    if (index === undefined) throw new Error("Spark gave no index");
    const deform = new dyno.Dyno({
      inTypes: {
        index: "int",
        splats: "sampler2D",
        arms: "sampler2D",
        bands: "sampler2D",
        bandScales: "mat4",
        cage: "sampler2D",
        sky: "sampler2D",
        skyRegion: "vec4",
        key: "sampler2D",
        keyRegion: "vec4",
        keySlope: "vec2",
        eye: "vec3",
        place: "mat4",
        normals: "sampler2D",
        irradiance: "mat4",
        degree: "int",
        marks: "sampler2D",
        activeMark: "int",
        maxStretch: "float",
      },
      outTypes: { covsplat: dyno.CovSplat },
      inputs: { index, ...uniforms },
      globals: () => [dyno.defineGsplat, dyno.defineCovSplat, DEFORM_GLSL, MARK_GLSL],
      statements: ({ inputs: i, outputs }) => [
        `${outputs.covsplat} = egsDeformed(${i.index}, ${i.splats}, ${i.arms}, ${i.bands}, ${i.bandScales}, ` +
          `${i.cage}, ${i.sky}, ${i.skyRegion}, ${i.key}, ${i.keyRegion}, ${i.keySlope}, ${i.eye}, ${i.place}, ` +
          `${i.normals}, ${i.irradiance}, ${i.degree}, ${i.maxStretch});`,
        `${outputs.covsplat}.rgba.rgb = ` +
          `egsMarked(${outputs.covsplat}.rgba.rgb, ${i.marks}, ${i.index}, ${i.activeMark});`,
      ],
    });
    if (occluders === undefined) return { covsplat: deform.outputs.covsplat };
    const shade = new dyno.Dyno({
      inTypes: {
        index: "int",
        covsplat: dyno.CovSplat,
        splats: "sampler2D",
        cage: "sampler2D",
        place: "mat4",
        table: "sampler2D",
        seeds: "sampler2D",
        levels: "sampler2D",
        up: "vec3",
      },
      outTypes: { covsplat: dyno.CovSplat },
      inputs: { index, covsplat: deform.outputs.covsplat, ...occluders },
      globals: () => [OCCLUSION_GLSL],
      statements: ({ inputs: i, outputs }) => [
        `${outputs.covsplat} = ${i.covsplat};`,
        `${outputs.covsplat}.rgba.rgb *= egsUnhidden(${i.index}, ${i.splats}, ${i.cage}, ${i.table}, ${i.seeds}, ` +
          `${i.levels}, ${i.up}, (inverse(${i.place}) * vec4(${i.covsplat}.center, 1.0)).xyz);`,
      ],
    });
    return { covsplat: shade.outputs.covsplat };
  });
  const generator = new SplatGenerator({
    numSplats: count,
    covGenerator,
    update: ({ object, camera }) => {
      object.updateWorldMatrix(true, false);
      if (!place.equals(object.matrixWorld)) object.updateVersion();
      place.copy(object.matrixWorld);
      camera?.getWorldPosition(eye);
      object.worldToLocal(eye);
    },
  });
  generator.frustumCulled = false;
  return {
    generator,
    update: () => generator.updateVersion(),
    mark: (labels, active) => {
      if (marks === undefined) return;
      marks.values.set(labels);
      marks.texture.needsUpdate = true;
      activeMark.value = labels.some((label) => label > 0) ? active : -1;
      generator.updateVersion();
    },
  };
}

/** Create a texture with one byte per splat. */
function markTexture(count: number): { texture: THREE.DataTexture; values: Uint8Array } {
  const rows = Math.max(1, Math.ceil(count / TEXTURE_WIDTH));
  const values = new Uint8Array(TEXTURE_WIDTH * rows);
  const texture = new THREE.DataTexture(values, TEXTURE_WIDTH, rows, THREE.RedFormat, THREE.UnsignedByteType);
  texture.needsUpdate = true;
  return { texture, values };
}

/** Create a texture with one RGB texel per splat. */
function normalTexture(normals: Uint8Array): THREE.DataTexture {
  const rows = Math.max(1, Math.ceil(normals.length / 3 / TEXTURE_WIDTH));
  const values = new Uint8Array(4 * TEXTURE_WIDTH * rows);
  for (let k = 0; k < normals.length / 3; k++) values.set(normals.subarray(3 * k, 3 * k + 3), 4 * k);
  const texture = new THREE.DataTexture(values, TEXTURE_WIDTH, rows, THREE.RGBAFormat, THREE.UnsignedByteType);
  texture.needsUpdate = true;
  return texture;
}

/** Create a texture with one RGB texel per coefficient above band 0. */
function bandTexture(bands: Uint8Array, count: number, degree: number): THREE.DataTexture {
  const each = (degree + 1) ** 2 - 1;
  const texels = Math.max(1, each * count);
  const rows = Math.ceil(texels / TEXTURE_WIDTH);
  const values = new Uint8Array(4 * TEXTURE_WIDTH * rows);
  for (let k = 0; k < each * count; k++) {
    for (let c = 0; c < 3; c++) values[4 * k + c] = bands[3 * k + c] as number;
  }
  const texture = new THREE.DataTexture(values, TEXTURE_WIDTH, rows, THREE.RGBAFormat, THREE.UnsignedByteType);
  texture.needsUpdate = true;
  return texture;
}
