// The report of a run: the timeline, and the data of a frame for the inspector.
"use strict";
const NAMES = {
  R: "R, reliability of the appearance", B: "B, risk of degradation", G: "G, geometric utility", C: "C, coverage gain",
  D: "D, pose diversity", O: "O, redundancy", Z: "Z, centrality in its bin",
};

// Files next to the folder of the report are not there in a report that is one file or comes from a server.
if (location.protocol !== "file:") document.documentElement.dataset.single = "";

// -- the data of a frame ------------------------------------------------------------------------------------
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

// Heading, text and folded data.
const part = (title, text, data = []) => {
  const section = make("section");
  section.append(make("h3", title), make("p", text));
  const shown = data.filter(Boolean);
  if (shown.length) {
    const folded = make("details");
    folded.append(make("summary", "Figures"), ...shown);
    section.append(folded);
  }
  return section;
};

const decibels = (frame) => (frame.psnr === null ? "" : `PSNR ${frame.psnr.toFixed(1)} dB`);

// The weight of the frame with its reason, then its PSNR and its role, a term of the paper.
const facts = (frame) => {
  const role = frame.weight_text.includes(frame.role) ? "" : `role by RVA: ${frame.role}`;
  return [frame.weight_text || "not rated", decibels(frame), role].filter(Boolean);
};

const describe = (frame) => {
  const scores = Object.entries(frame.scores).flatMap(([metric, found]) =>
    Object.entries(found).map(([name, value]) => [`${report.layers[name] ?? name}, ${metric}`, value]));
  const formation = Object.entries(frame.formation).map(([name, value]) => [name.replaceAll("_", " "), value, report.meanings[name]]);
  const figures = Object.entries(frame.figures).map(([name, value]) => [NAMES[name] ?? name, value]);
  one("#stand").hidden = frame.time === null || !report.viewer;
  return {
    view: `Frame ${frame.id}`,
    title: `Frame ${frame.id} · ${frame.name}`,
    role: facts(frame).join(" · "),
    details: [
      part("Weight in training", frame.weight_text || "not rated", [...pairs("Frame scores", figures), ...cues(frame)]),
      ...(frame.worst ? [part("Worst cue, from 0 (good) to 1 (bad)", frame.worst)] : []),
      part("Repair", frame.why ? `${frame.repair}: ${frame.why}` : frame.repair, pairs("Scores, higher is better", scores)),
      ...pairs("Camera effects", Object.entries(frame.found)),
      ...(formation.length ? [part("Image formation", "", pairs("Fitted values", formation))] : []),
      make("p", "Keys: ← and → for other frames, Esc to close.", "mute"),
    ],
  };
};

// -- the curves of the training: labels are HTML, so that their size does not follow that of the drawing ---------
{
  const shape = (parent, name, attributes) => {
    const element = parent.appendChild(document.createElementNS("http://www.w3.org/2000/svg", name));
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    return element;
  };
  const { steps, parts, curves } = report.training ?? { curves: [] };
  for (const { title, unit, digits, points } of curves) {
    const values = points.map(([, value]) => value);
    const [least, most] = [Math.min(...values), Math.max(...values)];
    const power = 10 ** Math.floor(Math.log10((most - least) / 4 || 1));
    const gap = [1, 2, 2.5, 5, 10].map((factor) => factor * power).find((size) => size * 4 >= most - least);
    const [low, high] = [Math.floor(least / gap) * gap, Math.max(Math.ceil(most / gap), Math.floor(least / gap) + 1) * gap];
    const y = (value) => (100 * (high - value)) / (high - low);
    const text = (value) => value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
    const [from, to] = [text(values[0]), `${text(values[values.length - 1])} ${unit}`.trim()];
    const figure = make("figure", undefined, "chart");
    const caption = figure.appendChild(make("figcaption"));
    caption.append(make("span", title), make("b", to), make("small", `from ${from}, over ${steps.toLocaleString("en")} steps`));
    const plot = figure.appendChild(make("div", undefined, "plot"));
    const label = `${title}: from ${from} to ${to} over ${steps} steps`;
    const svg = shape(plot, "svg", { viewBox: "0 0 100 100", preserveAspectRatio: "none", role: "img", "aria-label": label });
    for (let value = low; value <= high + gap / 2; value += gap) {
      shape(svg, "line", { class: "grid", x1: 0, x2: 100, y1: y(value), y2: y(value) });
      const tick = make("span", Number(value.toPrecision(6)).toLocaleString("en"), "tick");
      plot.append(Object.assign(tick, { style: `top: ${y(value)}%` }));
    }
    for (const [stage, start] of parts) {
      const x = (100 * start) / steps;
      if (start > 0) shape(svg, "line", { class: "part", x1: x, x2: x, y1: 0, y2: 100 });
      plot.append(Object.assign(make("span", stage, "part-name"), { style: `left: ${x}%` }));
    }
    const path = points.map(([step, value]) => `${((100 * step) / steps).toFixed(2)},${y(value).toFixed(2)}`);
    shape(svg, "path", { class: "line", d: `M${path.join(" L")}` });
    one("#curves").append(figure);
  }
}

// -- the timeline: a lane of bars per figure, and a scrubber over all ----------------------------------------
{
  const LANES = [
    { title: "Weight in training", of: (frame) => frame.weight, low: 0, high: 1, unit: "" },
    { title: "Camera speed", of: (frame) => frame.found["camera speed, px per video frame"], low: 0, unit: " px per video frame" },
    { title: "Motion blur", of: (frame) => frame.found["blur, px"], low: 0, unit: " px" },
    { title: "PSNR per frame", of: (frame) => frame.psnr, unit: " dB", tall: true, worst: true },
    { title: "Rolling shutter", of: (frame) => frame.found["rolling shutter, px"], low: 0, unit: " px", only: 1 },
    { title: "Defocus", of: (frame) => frame.found["defocus, px"], low: 0, unit: " px", only: 1 },
    { title: "Exposure", of: (frame) => frame.found["exposure, stops"], unit: " stops", only: 0.1 },
  ];
  const frames = report.frames;
  const lanes = one("#lanes");
  const scrub = one("#scrub");
  const isPoor = (frame) => frame.psnr !== null && frame.psnr < report.poor;
  const kind = (frame, lane) => (frame.role === "held out" ? "held" : lane.worst && isPoor(frame) ? "worst" : "");

  // The lane is left out where no frame has the figure, or where all are below `only`.
  const draw = (lane) => {
    const values = frames.map((frame) => lane.of(frame) ?? null);
    const known = values.filter((value) => value !== null);
    if (known.length === 0 || (lane.only && !known.some((value) => Math.abs(value) >= lane.only))) return;
    const [least, most] = [Math.min(...known), Math.max(...known)];
    const high = lane.high ?? Math.max(most, (lane.low ?? least) + 1e-6);
    const low = lane.low ?? (least > 0 ? Math.max(0, least - 0.15 * (most - least) - 0.5) : least);
    const digits = lane.high ? 2 : 1;
    const label = make("p", undefined, "lane-name");
    const range = `${least.toFixed(digits)} to ${most.toFixed(digits)}${lane.unit}`;
    const marks = [frames.some((frame) => kind(frame, lane) === "worst") && `red: below ${report.poor} dB`, frames.some((frame) => kind(frame, lane) === "held") && "blue: held out"];
    label.append(make("b", lane.title), make("span", [range, ...(lane.worst ? marks.filter(Boolean) : [])].join(" · ")));
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    for (const [name, value] of [
      ["viewBox", `0 0 ${frames.length} 100`], ["preserveAspectRatio", "none"], ["role", "img"],
      ["class", lane.tall ? "tall" : ""], ["aria-label", `${lane.title} of ${known.length} frames: ${range}`],
    ]) svg.setAttribute(name, value);
    const y = (value) => 100 - (100 * (value - low)) / (high - low);
    values.forEach((value, index) => {
      if (value === null) return;
      const [from, to] = [y(Math.max(low, Math.min(0, high))), y(value)];
      const bar = svg.appendChild(document.createElementNS("http://www.w3.org/2000/svg", "rect"));
      const height = Math.max(Math.abs(from - to), 2);
      const place = { x: index + 0.1, width: 0.8, y: Math.min(from, to, 100 - height), height, class: kind(frames[index], lane) };
      for (const [name, number] of Object.entries(place)) bar.setAttribute(name, number);
    });
    scrub.before(label, svg);
  };
  LANES.forEach(draw);
  lanes.style.setProperty("--frames", frames.length);

  // Shows a frame in the timeline, and its image. The 3D viewer follows unless `camera` is false.
  const select = (index, camera = true) => {
    const frame = frames[Math.max(0, Math.min(frames.length - 1, index))];
    scrub.value = frames.indexOf(frame);
    lanes.style.setProperty("--at", scrub.value);
    scrub.setAttribute("aria-valuetext", `frame ${frame.id}`);
    const shown = [...facts(frame), ...(frame.time === null ? ["its camera is not known"] : [])];
    one("#readout").replaceChildren(make("b", `Frame ${frame.id}`), make("span", shown.join(" · ")));
    const filmed = one("#filmed");
    if (filmed) {
      filmed.src = asset(frame.layers.observed);
      filmed.alt = `Frame ${frame.id}, as filmed`;
      one("#filmed-name").textContent = `, frame ${frame.id}`;
    }
    if (camera && frame.time !== null) window.reportStage?.goTo(frame.time);
  };
  window.timeline = { select, index: () => Number(scrub.value) };

  scrub.addEventListener("input", () => select(Number(scrub.value)));
  addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step || event.ctrlKey || event.altKey || event.metaKey || inspector.open || event.target === scrub) return;
    if (["INPUT", "SELECT", "TEXTAREA"].includes(event.target.tagName)) return;
    event.preventDefault();
    event.stopPropagation(); // the 3D viewer would move sideways
    select(Number(scrub.value) + step);
  }, { capture: true });
  one("#inspect").addEventListener("click", () => inspect(Number(scrub.value)));

  // An address with #frame-12 opens the inspector at that frame.
  const follow = () => {
    const id = /^#frame-(\d+)$/.exec(location.hash)?.[1];
    if (id !== undefined && indexOf(id) >= 0) inspect(indexOf(id));
  };
  addEventListener("hashchange", follow);
  select(Math.max(0, indexOf(report.start ?? frames[0]?.id)));
  follow();
}
