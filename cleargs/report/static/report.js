// The report without its 3D: copying, the filter of the strip, and the inspector of one frame.
"use strict";
const report = JSON.parse(document.getElementById("data").textContent);
const one = (selector, root = document) => root.querySelector(selector);
const all = (selector, root = document) => [...root.querySelectorAll(selector)];

const make = (tag, text, className) => {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = text;
  if (className) element.className = className;
  return element;
};

// -- copying ------------------------------------------------------------------------------------------------
const copy = async (text) => {
  try {
    await navigator.clipboard.writeText(text);
  } catch { // browsers that keep the clipboard from pages on a disk
    const area = document.body.appendChild(make("textarea"));
    area.value = text;
    area.select();
    document.execCommand("copy");
    area.remove();
  }
};
for (const button of all("[data-copy]")) {
  button.addEventListener("click", async () => {
    await copy(button.dataset.copy);
    const before = button.textContent;
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = before; }, 1200);
  });
}

// -- the strip ----------------------------------------------------------------------------------------------
for (const pill of all("#filters button")) {
  pill.addEventListener("click", () => {
    for (const other of all("#filters button")) other.setAttribute("aria-pressed", String(other === pill));
    for (const item of all("#strip li")) item.hidden = pill.dataset.role !== "" && item.dataset.role !== pill.dataset.role;
  });
}

// -- the inspector ------------------------------------------------------------------------------------------
const inspector = one("#inspector");
const [leftPicture, rightPicture] = [one("#left"), one("#right")];
const [leftChoice, rightChoice] = [one("#left-layer"), one("#right-layer")];
const slider = one("#slider");
const chosenLayers = { left: "observed", right: "final" };
let current = 0;

const number = (value) => (typeof value === "number" ? value.toFixed(Math.abs(value) < 10 ? 2 : 1) : String(value));

const NAMES = {
  R: "R, reliable appearance", B: "B, risk of degradation", G: "G, worth of its place", C: "C, coverage gained",
  D: "D, new directions", O: "O, seen already", Z: "Z, middle of its stretch",
};

const pairs = (title, entries) => {
  if (entries.length === 0) return [];
  const section = make("section");
  const list = make("dl", undefined, "pairs");
  for (const [name, value, meaning] of entries) {
    const term = make("dt", name);
    if (meaning) term.title = meaning;
    list.append(term, make("dd", value === null ? "–" : number(value)));
  }
  section.append(make("h3", title), list);
  return [section];
};

const cues = (frame) => {
  const entries = Object.entries(frame.cues);
  if (entries.length === 0) return [];
  const section = make("section");
  section.append(make("h3", "Cues: how bad, from 0 to 1"));
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

const fillChoice = (choice, frame, wanted, fallback) => {
  const names = Object.keys(frame.layers);
  choice.replaceChildren(...names.map((name) => {
    const label = report.layers[name] + (name === frame.chosen ? " (chosen)" : "");
    return Object.assign(make("option", label), { value: name });
  }));
  choice.value = names.includes(wanted) ? wanted : fallback;
};

const showLayers = (frame) => {
  for (const [side, choice, picture] of [["left", leftChoice, leftPicture], ["right", rightChoice, rightPicture]]) {
    const label = report.layers[choice.value];
    picture.src = frame.layers[choice.value];
    picture.alt = `Frame ${frame.id}: ${label}`;
    one(`#tag-${side}`).textContent = label;
  }
  fillContact(frame);
};

// Every layer in small; choosing one lays it on the right.
const fillContact = (frame) => {
  one("#contact").replaceChildren(...Object.entries(frame.layers).map(([name, path]) => {
    const button = Object.assign(make("button"), { type: "button" });
    button.setAttribute("aria-pressed", String(name === rightChoice.value));
    const label = report.layers[name] + (name === frame.chosen ? " (chosen)" : "");
    button.append(Object.assign(make("img"), { src: path, alt: "" }), label);
    button.addEventListener("click", () => choose("right", name));
    return button;
  }));
};

const choose = (side, name) => {
  chosenLayers[side] = name;
  (side === "left" ? leftChoice : rightChoice).value = name;
  showLayers(report.frames[current]);
};

const inspect = (index) => {
  current = (index + report.frames.length) % report.frames.length;
  const frame = report.frames[current];
  const names = Object.keys(frame.layers);
  one("#inspector-title").textContent = `Frame ${frame.id} · ${frame.name}`;
  const weight = frame.weight === null ? "" : `, weight ${frame.weight.toFixed(2)}`;
  one("#inspector-role").textContent = (frame.role || "not judged") + weight;
  fillChoice(leftChoice, frame, chosenLayers.left, names[0]);
  fillChoice(rightChoice, frame, chosenLayers.right, frame.chosen ?? names[names.length - 1]);
  showLayers(frame);
  one("#stand").hidden = frame.time === null || !report.viewer;
  one("#details").replaceChildren(
    ...decision(frame), ...cues(frame), ...pairs("Scores of the allocation", Object.entries(frame.figures).map(([name, value]) => [NAMES[name] ?? name, value])),
    ...pairs("Found", Object.entries(frame.found)),
    ...pairs("Image formation", frame.formation.map(({ name, value, meaning }) => [name, value, meaning])));
  if (!inspector.open) inspector.showModal();
};

const indexOf = (id) => report.frames.findIndex((frame) => frame.id === Number(id));
for (const opener of all(".card, .bar-of")) opener.addEventListener("click", () => inspect(indexOf(opener.dataset.frame)));
for (const step of all("[data-step]")) step.addEventListener("click", () => inspect(current + Number(step.dataset.step)));
one(".close", inspector).addEventListener("click", () => inspector.close());
inspector.addEventListener("click", (event) => { if (event.target === inspector) inspector.close(); });
inspector.addEventListener("keydown", (event) => {
  if (["INPUT", "SELECT"].includes(event.target.tagName)) return; // arrows move the slider there
  if (event.key === "ArrowLeft") inspect(current - 1);
  if (event.key === "ArrowRight") inspect(current + 1);
});
for (const [side, choice] of [["left", leftChoice], ["right", rightChoice]]) {
  choice.addEventListener("change", () => choose(side, choice.value));
}
slider.addEventListener("input", () => one(".overlay").style.setProperty("--cut", `${slider.value}%`));
