// Words for the stages of the preparation of a live creature.

/** Stages before the capture is shown. */
const EARLY_STAGES: Record<string, string> = {
  "up direction": "finding which way is up",
  preview: "loading the capture into this page",
};
/** Stages after the up direction is known, in order (egs_warp/pipelines/creature.py and egs_warp/commands/live.py). */
const BODY_STAGES: Record<string, string> = {
  cage: "fitting a cage of tetrahedra around it",
  front: "finding its front",
  contact: "finding where it can touch the ground",
  "body and muscles": "giving it a soft body and muscles",
  stand: "letting it stand",
  split: "refining its surface where it will bend",
};

/** Text of the page while the body is prepared. */
export function preparationText(stage: string): string {
  if (stage === "") return "Preparing the body\u2026";
  if (EARLY_STAGES[stage] !== undefined) return `Preparing the body: ${EARLY_STAGES[stage]}\u2026`;
  const step = Object.keys(BODY_STAGES).indexOf(stage);
  if (step < 0) return `Separating the object from its scene: ${stage}\u2026`;
  return `Preparing the body, step ${step + 1} of ${Object.keys(BODY_STAGES).length}: ${BODY_STAGES[stage]}\u2026`;
}
