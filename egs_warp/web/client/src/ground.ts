// Ground plane with a grid that fades with distance, and the creature's soft shadow on it.

import * as THREE from "three";

const SHADOW_SIDE = 256;

export class Ground {
  /** Shadow map and its region on the ground: centre (x, y), half its side length, body height. */
  readonly shadow: { texture: THREE.Texture; region: THREE.Vector4 };
  readonly mesh: THREE.Mesh<THREE.PlaneGeometry, THREE.ShaderMaterial>;
  private readonly target: THREE.WebGLRenderTarget;
  private readonly camera: THREE.OrthographicCamera;
  private readonly caster: THREE.Mesh;
  private readonly casters = new THREE.Scene();
  private readonly points: THREE.BufferAttribute;

  constructor(
    surface: Int32Array,
    nodeCount: number,
    private readonly height: number,
    reach: number,
  ) {
    this.target = new THREE.WebGLRenderTarget(SHADOW_SIDE, SHADOW_SIDE, { depthBuffer: false });
    const half = 1.5 * height;
    this.shadow = { texture: this.target.texture, region: new THREE.Vector4(0, 0, half, height) };
    this.camera = new THREE.OrthographicCamera(-half, half, half, -half, -100 * height, 100 * height);
    const geometry = new THREE.BufferGeometry();
    this.points = new THREE.BufferAttribute(new Float32Array(3 * nodeCount), 3);
    geometry.setAttribute("position", this.points);
    geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(surface), 1));
    this.caster = new THREE.Mesh(
      geometry,
      new THREE.ShaderMaterial({
        uniforms: { height: { value: height } },
        vertexShader: `varying float z;
          void main() { z = position.z; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
        fragmentShader: `uniform float height; varying float z;
          void main() {
            float dark = 1.0 / (1.0 + 6.0 * max(z, 0.0) / height); gl_FragColor = vec4(dark, 0.0, 0.0, 1.0);
          }`,
        side: THREE.DoubleSide,
        depthTest: false,
        blending: THREE.CustomBlending,
        blendEquation: THREE.MaxEquation,
        blendSrc: THREE.OneFactor,
        blendDst: THREE.OneFactor,
      }),
    );
    this.caster.frustumCulled = false;
    this.casters.add(this.caster);
    const material = new THREE.ShaderMaterial({
      uniforms: {
        shade: { value: this.target.texture },
        centre: { value: new THREE.Vector2() },
        shadeCentre: { value: new THREE.Vector2() },
        shadeHalf: { value: half },
        reach: { value: reach },
        cell: { value: 0.25 * height },
        softness: { value: 0.04 },
        box: { value: new THREE.Vector4() },
      },
      vertexShader: `varying vec3 world;
        void main() {
          vec4 p = modelMatrix * vec4(position, 1.0); world = p.xyz;
          gl_Position = projectionMatrix * viewMatrix * p;
        }`,
      fragmentShader: `
        varying vec3 world; uniform sampler2D shade; uniform vec2 centre, shadeCentre;
        uniform float shadeHalf, reach, cell, softness; uniform vec4 box;
        float line(vec2 p, float width) {
          vec2 d = abs(fract(p / cell + 0.5) - 0.5) * cell, w = fwidth(p) * width;
          vec2 l = clamp(1.0 - d / w, 0.0, 1.0) * clamp(0.35 * cell / w, 0.0, 1.0);
          return max(l.x, l.y);
        }
        void main() {
          vec2 p = world.xy;
          float fade = smoothstep(1.0, 0.25, distance(p, centre) / reach);
          vec3 colour = mix(vec3(0.105, 0.115, 0.13), vec3(0.21, 0.23, 0.26), line(p, 1.1));
          vec2 uv = 0.5 + 0.5 * (p - shadeCentre) / shadeHalf;
          if (all(greaterThan(uv, box.xy)) && all(lessThan(uv, box.zw))) {
            float dark = 0.0;
            for (int i = 0; i < 12; i++) {
              float a = 2.399963 * float(i), r = sqrt((float(i) + 0.5) / 12.0) * softness;
              dark += texture2D(shade, uv + r * vec2(cos(a), sin(a))).r;
            }
            colour *= 1.0 - 0.06 * dark;
          }
          gl_FragColor = vec4(colour, fade);
        }`,
      transparent: true,
      depthWrite: false,
    });
    this.mesh = new THREE.Mesh(new THREE.PlaneGeometry(2 * reach, 2 * reach), material);
    this.mesh.renderOrder = -10;
  }

  centreOn(x: number, y: number): void {
    this.mesh.position.set(x, y, 0);
    (this.mesh.material.uniforms.centre!.value as THREE.Vector2).set(x, y);
  }

  /** Render the shadow map of the cage at node `positions`, centred at `centreOfMass`. */
  cast(renderer: THREE.WebGLRenderer, positions: Float32Array, centreOfMass: THREE.Vector3): void {
    (this.points.array as Float32Array).set(positions);
    this.points.needsUpdate = true;
    const { uniforms } = this.mesh.material;
    (uniforms.shadeCentre!.value as THREE.Vector2).set(centreOfMass.x, centreOfMass.y);
    uniforms.softness!.value = 0.02 + 0.05 * Math.min(Math.max(centreOfMass.z / this.height - 0.2, 0), 1.5);
    this.updateShadowBox(positions, centreOfMass, uniforms.softness!.value as number);
    this.camera.position.set(centreOfMass.x, centreOfMass.y, 0);
    this.shadow.region.x = centreOfMass.x;
    this.shadow.region.y = centreOfMass.y;
    const saved = {
      target: renderer.getRenderTarget(),
      colour: renderer.getClearColor(new THREE.Color()),
      alpha: renderer.getClearAlpha(),
    };
    renderer.setRenderTarget(this.target);
    renderer.setClearColor(0x000000, 1);
    renderer.clear();
    renderer.render(this.casters, this.camera);
    renderer.setRenderTarget(saved.target);
    renderer.setClearColor(saved.colour, saved.alpha);
  }

  /** Set the bounding box of the shadow; the shader samples the shadow map only inside it. */
  private updateShadowBox(positions: Float32Array, centreOfMass: THREE.Vector3, softness: number): void {
    let [left, right, near, far] = [Infinity, -Infinity, Infinity, -Infinity];
    for (let k = 0; k < positions.length; k += 3) {
      left = Math.min(left, positions[k]!);
      right = Math.max(right, positions[k]!);
      near = Math.min(near, positions[k + 1]!);
      far = Math.max(far, positions[k + 1]!);
    }
    const half = this.shadow.region.z;
    const at = (x: number, centre: number): number => 0.5 + (0.5 * (x - centre)) / half;
    // One texel more than the blur radius, clipped to the shadow map.
    const edge = softness + 2 / SHADOW_SIDE;
    (this.mesh.material.uniforms.box!.value as THREE.Vector4).set(
      Math.max(at(left, centreOfMass.x) - edge, 0),
      Math.max(at(near, centreOfMass.y) - edge, 0),
      Math.min(at(right, centreOfMass.x) + edge, 1),
      Math.min(at(far, centreOfMass.y) + edge, 1),
    );
  }
}
