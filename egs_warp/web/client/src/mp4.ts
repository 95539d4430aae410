// MP4 file with one video track in which all frames have the same duration (ISO/IEC 14496-12, -14 and -15; VP9 in MP4:
// the "VP Codec ISO Media File Format Binding").

export interface Mp4Track {
  width: number;
  height: number;
  /** Frames per second. */
  rate: number;
  /** Codec string, such as `avc1.42E034` or `vp09.00.51.08`. */
  codec: string;
  /** Decoder configuration of H.264 (AVCDecoderConfigurationRecord); unused for VP9. */
  description: Uint8Array<ArrayBuffer>;
  /** Encoded frames in order of time. */
  frames: { data: Uint8Array<ArrayBuffer>; isKey: boolean }[];
}

type Bytes = Uint8Array<ArrayBuffer>;

/** Ticks per frame of the track's clock. */
const TICKS = 1000;
const VIDEO_BRAND = "isom";
/** Colours of `VideoFrame`s of a canvas: BT.709 primaries, the sRGB transfer function, and the BT.709 matrix. */
const COLOURS = [1, 13, 1] as const;
/** The identity as a matrix of 16.16 and 2.30 fixed-point numbers. */
const IDENTITY = [0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000];

/** Return the file with `track`, whose index comes before the frames, so that players can start before they have read
 * all of it. */
export function mp4File(track: Mp4Track): Blob {
  const type = box("ftyp", text(VIDEO_BRAND), u32(512), text(VIDEO_BRAND), text("mp41"));
  // The size of the index does not depend on the position of the frames.
  const start = type.length + index(track, 0).length + 8;
  const size = track.frames.reduce((sum, { data }) => sum + data.length, 0);
  const parts = [type, index(track, start), u32(size + 8), text("mdat"), ...track.frames.map(({ data }) => data)];
  return new Blob(parts, { type: "video/mp4" });
}

/** Return the box `moov` of a file whose frames start at byte `start`. */
function index(track: Mp4Track, start: number): Bytes {
  const { frames, width, height, rate } = track;
  const clock = [Math.round(rate * TICKS), frames.length * TICKS];
  const keys = frames.flatMap(({ isKey }, k) => (isKey ? [k + 1] : []));
  const table = box(
    "stbl",
    full("stsd", 0, u32(1), sampleEntry(track)),
    full("stts", 0, u32(1, frames.length, TICKS)),
    full("stss", 0, u32(keys.length, ...keys)),
    full("stsc", 0, u32(1, 1, frames.length, 1)),
    full("stsz", 0, u32(0, frames.length, ...frames.map(({ data }) => data.length))),
    full("stco", 0, u32(1, start)),
  );
  const data = box("dinf", full("dref", 0, u32(1), full("url ", 1)));
  const media = box(
    "mdia",
    // The language code is "und".
    full("mdhd", 0, u32(0, 0, ...clock), u16(0x55c4, 0)),
    full("hdlr", 0, u32(0), text("vide"), u32(0, 0, 0), text("video\0")),
    box("minf", full("vmhd", 1, u16(0, 0, 0, 0)), data, table),
  );
  const rest = [u16(0x100, 0), u32(0, 0, ...IDENTITY), zeros(24), u32(2)];
  const header = full("mvhd", 0, u32(0, 0, ...clock, 0x10000), ...rest);
  // The track is enabled, and used in the presentation.
  const size = u32(width * 0x10000, height * 0x10000);
  const trackHeader = full("tkhd", 3, u32(0, 0, 1, 0, clock[1]!, 0, 0), u16(0, 0, 0, 0), u32(...IDENTITY), size);
  return box("moov", header, box("trak", trackHeader, media));
}

function sampleEntry({ width, height, codec, description }: Mp4Track): Bytes {
  const isH264 = codec.startsWith("avc1");
  const colours = box("colr", text("nclx"), u16(...COLOURS), u8(0));
  const resolution = u32(0x480000, 0x480000, 0);
  return box(
    codec.slice(0, 4),
    ...[zeros(6), u16(1), zeros(16), u16(width, height), resolution, u16(1), zeros(32), u16(24, 0xffff)],
    isH264 ? box("avcC", description) : full("vpcC", 0x01000000, vp9Configuration(codec)),
    colours,
  );
}

/** Return the body of the box `vpcC` of a codec string `vp09.PROFILE.LEVEL.DEPTH`: 4:2:0, limited range. */
function vp9Configuration(codec: string): Bytes {
  const [profile, level, depth] = codec.split(".").slice(1).map(Number) as [number, number, number];
  return u8(profile, level, (depth << 4) | (1 << 1), ...COLOURS, 0, 0);
}

function box(name: string, ...content: Bytes[]): Bytes {
  return concatenated(u32(8 + content.reduce((sum, { length }) => sum + length, 0)), text(name), ...content);
}

/** Return a box with a version and `flags`. */
function full(name: string, flags: number, ...content: Bytes[]): Bytes {
  return box(name, u32(flags), ...content);
}

function u8(...values: number[]): Bytes {
  return Uint8Array.from(values);
}

function u16(...values: number[]): Bytes {
  return Uint8Array.from(values.flatMap((value) => [value >>> 8, value]));
}

function u32(...values: number[]): Bytes {
  return Uint8Array.from(values.flatMap((value) => [value >>> 24, value >>> 16, value >>> 8, value]));
}

function text(letters: string): Bytes {
  return Uint8Array.from(letters, (letter) => letter.charCodeAt(0));
}

function zeros(count: number): Bytes {
  return new Uint8Array(count);
}

function concatenated(...parts: Bytes[]): Bytes {
  const all = new Uint8Array(parts.reduce((sum, { length }) => sum + length, 0));
  let at = 0;
  for (const part of parts) {
    all.set(part, at);
    at += part.length;
  }
  return all;
}
