// Functions of all pages: addresses of images, buttons that copy text, filters of a list, and printing.
"use strict";
const one = (selector, root = document) => root.querySelector(selector);
const all = (selector, root = document) => [...root.querySelectorAll(selector)];

const make = (tag, text, className) => {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = text;
  if (className) element.className = className;
  return element;
};

// Address of an image of the page. A report in one file contains its images.
const asset = (path) => window.files?.[path] ?? path;

// -- copying ------------------------------------------------------------------------------------------------
const copy = async (text) => {
  try {
    await navigator.clipboard.writeText(text);
  } catch { // some browsers deny the clipboard to pages that are opened from disk
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

// -- filters -----------------------------------------------------------------------------------------------
for (const pill of all("#filters button")) {
  pill.addEventListener("click", () => {
    for (const other of all("#filters button")) other.setAttribute("aria-pressed", String(other === pill));
    for (const item of all("#strip li")) item.hidden = pill.dataset.kind !== "" && item.dataset.kind !== pill.dataset.kind;
  });
}

// -- printing: folded parts are printed too ------------------------------------------------------------------
addEventListener("beforeprint", () => {
  for (const folded of all("details:not([open])")) { folded.open = true; folded.dataset.folds = ""; }
});
addEventListener("afterprint", () => {
  for (const folded of all("[data-folds]")) { folded.open = false; delete folded.dataset.folds; }
});
