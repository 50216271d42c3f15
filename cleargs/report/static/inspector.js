// The inspector: two layers of one view under a slider. The page defines `describe(frame)`, which returns the name of
// the view (`view`), the title and the line below it (`title`, `role`), and elements with data (`details`).
"use strict";
const report = JSON.parse(document.getElementById("data").textContent);
const inspector = one("#inspector");
const [leftPicture, rightPicture] = [one("#left"), one("#right")];
const [leftChoice, rightChoice] = [one("#left-layer"), one("#right-layer")];
const slider = one("#slider");
const chosenLayers = { ...report.opening };
let current = 0;

const number = (value) => (typeof value === "number" ? value.toFixed(Math.abs(value) < 10 ? 2 : 1) : String(value));

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

const fillChoice = (choice, frame, wanted, fallback) => {
  const names = Object.keys(frame.layers);
  choice.replaceChildren(...names.map((name) => {
    const label = report.layers[name] + (name === frame.chosen ? " (repair)" : "");
    return Object.assign(make("option", label), { value: name });
  }));
  choice.value = names.includes(wanted) ? wanted : fallback;
};

const showLayers = (frame) => {
  for (const [side, choice, picture] of [["left", leftChoice, leftPicture], ["right", rightChoice, rightPicture]]) {
    const label = report.layers[choice.value];
    picture.src = asset(frame.layers[choice.value]);
    picture.alt = `${describe(frame).view}: ${label}`;
    one(`#tag-${side}`).textContent = label;
  }
  fillContact(frame);
};

// Thumbnails of all layers. A click shows a layer on the right.
const fillContact = (frame) => {
  one("#contact").replaceChildren(...Object.entries(frame.layers).map(([name, path]) => {
    const button = Object.assign(make("button"), { type: "button" });
    button.setAttribute("aria-pressed", String(name === rightChoice.value));
    const label = report.layers[name] + (name === frame.chosen ? " (repair)" : "");
    button.append(Object.assign(make("img"), { src: asset(path), alt: "", loading: "lazy" }), label);
    if (frame.notes?.[name]) button.append(make("small", frame.notes[name]));
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
  const { title, role, details } = describe(frame);
  one("#inspector-title").textContent = title;
  one("#inspector-role").textContent = role;
  if (frame.aspect) inspector.style.setProperty("--aspect", frame.aspect);
  fillChoice(leftChoice, frame, chosenLayers.left, names[0]);
  fillChoice(rightChoice, frame, chosenLayers.right, frame.chosen ?? names[names.length - 1]);
  showLayers(frame);
  one("#details").replaceChildren(...details);
  if (!inspector.open) inspector.showModal();
};

const indexOf = (id) => report.frames.findIndex((frame) => frame.id === Number(id));
for (const opener of all("[data-opens]")) {
  opener.addEventListener("click", (event) => {
    event.preventDefault();
    if (opener.dataset.layer) chosenLayers.right = opener.dataset.layer;
    inspect(indexOf(opener.dataset.opens));
  });
}
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
