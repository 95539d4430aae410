// Colours of the mechanical layers and of their legend, sRGB.

export const LAYER_COLOURS = {
  cage: 0x2f5f9e,
  relaxed: 0xf6f1e2,
  contracts: 0xff4a2b,
  extends: 0x2f8dff,
  force: 0xffc021,
  cone: 0x35c79a,
  point: 0x35c79a,
  past: 0xa06bff,
  future: 0xd9ccf5,
  plan: 0xffffff,
  plumb: 0x6f7a8a,
  centre: 0xffffff,
  loaded: 0x35c79a,
  lifted: 0x8a94a6,
};
