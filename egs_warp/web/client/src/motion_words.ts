// Words for what a creature does and does next.

const DOING: Record<string, string> = { stand: "standing", drive: "moving" };
const NEXT: Record<string, string> = { go: "to the point", drive: "move" };

/** Return the words for the current motion of a creature, as the session reports it. */
export function doingText(doing: string): string {
  return DOING[doing] ?? doing;
}

/** Return the words for the motion that comes next. */
export function nextText(motion: string): string {
  return NEXT[motion] ?? motion;
}
