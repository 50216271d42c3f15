// Data of one frame in the report of a run.
"use strict";
const NAMES = {
  R: "R, reliability", B: "B, risk of degradation", G: "G, geometric utility", C: "C, coverage gain",
  D: "D, pose diversity", O: "O, redundancy", Z: "Z, centrality in its bin",
};

const cues = (frame) => {
  const entries = Object.entries(frame.cues);
  if (entries.length === 0) return [];
  const section = make("section");
  section.append(make("h3", "Cues, from 0 (good) to 1 (bad)"));
  for (const [name, value] of entries) {
    const line = make("div", undefined, "cue");
    const bar = make("i");
    const fill = bar.appendChild(make("b"));
    fill.style.width = `${100 * value}%`;
    line.append(make("span", name), bar, make("span", value.toFixed(2)));
    section.append(line);
  }
  return [section];
};

const decision = (frame) => {
  const section = make("section");
  section.append(make("h3", "Repair"), make("p", frame.why ? `${frame.repair}: ${frame.why}` : frame.repair));
  const scores = Object.entries(frame.scores).flatMap(([metric, found]) =>
    Object.entries(found).map(([name, value]) => [`${report.layers[name] ?? name}, ${metric}`, value]));
  return [section, ...pairs("Scores, higher is better", scores)];
};

const describe = (frame) => {
  const weight = frame.weight === null ? "" : `, weight ${frame.weight.toFixed(2)}`;
  const figures = Object.entries(frame.figures).map(([name, value]) => [NAMES[name] ?? name, value]);
  const formation = frame.formation.map(({ name, value, meaning }) => [name, value, meaning]);
  one("#stand").hidden = frame.time === null || !report.viewer;
  return {
    view: `Frame ${frame.id}`,
    title: `Frame ${frame.id} · ${frame.name}`,
    role: (frame.role || "not rated") + weight,
    details: [
      ...decision(frame), ...cues(frame), ...pairs("Frame scores", figures),
      ...pairs("Camera effects", Object.entries(frame.found)), ...pairs("Image formation", formation)],
  };
};
