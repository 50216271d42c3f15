// The two scenes in 3D. The viewer and the scenes are scripts, since a page that is opened from disk may not read files.
// The user controls the second viewer. The first viewer copies its camera in every frame.
"use strict";
{
  const stage = one("#stage");
  const status = one("#status");
  const { settings, scenes, start } = report.viewer;
  const panes = Object.fromEntries(all(".pane").map((pane) => [pane.dataset.scene, pane]));
  let before = null;
  let after = null;

  const loadScript = (name) => new Promise((resolve, reject) => {
    const script = Object.assign(document.createElement("script"), { src: `${name}.js`, onload: resolve });
    script.onerror = () => reject(new Error(`${name}.js is missing`));
    document.head.append(script);
  });

  // Loads a script that contains gzipped content in base64, and returns a URL of the content.
  const unpack = async (name, file, type) => {
    await loadScript(file);
    const bytes = Uint8Array.from(atob(window.packed[name]), (letter) => letter.charCodeAt(0));
    delete window.packed[name];
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return URL.createObjectURL(new Blob([await new Response(stream).arrayBuffer()], { type }));
  };

  const cameraOf = (viewer) => viewer.app.root.findByName("camera");

  const loaded = (viewer) => new Promise((resolve) => {
    if (viewer.state.loaded) resolve();
    else viewer.events.once("loaded:changed", resolve);
  });

  const open = async (module, scene) => {
    const url = await unpack(scene.key, `scene-${scene.key}`, "application/octet-stream");
    const viewer = await module.createViewer({
      container: one(".live", panes[scene.key]),
      settings,
      contentUrl: url,
      contentFilename: "scene.compressed.ply",
      renderer: new URLSearchParams(location.search).has("webgpu") ? "webgpu" : "webgl",
      ui: false,
      noanim: true,
      aa: scene.antialias,
    });
    viewer.state.inputEnabled = false; // the page uses the keyboard until the stage has the focus
    await loaded(viewer);
    viewer.seek(start);
    viewer.app.once("frameend", () => panes[scene.key].classList.add("ready"));
    viewer.app.renderNextFrame = true;
    return viewer;
  };

  const follow = () => {
    const [from, to] = [cameraOf(after), cameraOf(before)];
    before.app.on("update", () => {
      to.setPosition(from.getPosition());
      to.setRotation(from.getRotation());
      for (const name of ["fov", "nearClip", "farClip"]) to.camera[name] = from.camera[name];
    });
  };

  const begin = async () => {
    try {
      const module = await import(await unpack("viewer", "viewer", "text/javascript"));
      after = await open(module, scenes[1]);
      before = await open(module, scenes[0]);
      follow();
      status.textContent = "";
    } catch (error) {
      status.textContent = "3D is not available in this browser. These are still images.";
      console.warn(error);
    }
    document.documentElement.dataset.stage = after && before ? "ready" : "failed";
  };
  new IntersectionObserver((entries, observer) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    observer.disconnect();
    begin();
  }, { rootMargin: "200px" }).observe(stage);

  // -- input: events on the left viewer are sent to the right viewer ---------------------------------------
  for (const type of ["pointerdown", "wheel", "contextmenu"]) {
    panes.before.addEventListener(type, (event) => {
      if (!after) return;
      event.preventDefault();
      event.stopPropagation();
      after.app.graphicsDevice.canvas.dispatchEvent(new event.constructor(type, event));
    }, { capture: true, passive: false });
  }
  stage.addEventListener("focusin", () => { if (after) after.state.inputEnabled = true; });
  stage.addEventListener("focusout", () => { if (after) after.state.inputEnabled = false; });
  stage.addEventListener("pointerdown", () => stage.focus({ preventScroll: true }));

  const setMode = (mode) => {
    stage.dataset.mode = mode;
    for (const button of all("#controls [data-mode]")) button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
  };
  for (const button of all("#controls [data-mode]")) button.addEventListener("click", () => setMode(button.dataset.mode));
  one("#wipe").addEventListener("input", (event) => stage.style.setProperty("--wipe", `${event.target.value}%`));
  if (matchMedia("(max-width: 44rem)").matches) setMode("wipe");

  // -- the camera -----------------------------------------------------------------------------------------
  const playing = () => after.state.cameraMode === "anim" && !after.state.animationPaused;
  const play = one('[data-act="play"]');
  const act = {
    play: () => {
      const on = !playing();
      if (on) after.state.cameraMode = "anim";
      after.state.animationPaused = !on;
      play.setAttribute("aria-pressed", String(on));
    },
    start: () => goTo(start),
    all: () => after.frameScene(),
    full: () => (document.fullscreenElement ? document.exitFullscreen() : stage.requestFullscreen()),
  };
  for (const button of all("#controls [data-act]")) {
    button.addEventListener("click", () => { if (after) act[button.dataset.act](); });
  }

  const goTo = (time) => {
    if (!after) return;
    after.state.animationPaused = true;
    play.setAttribute("aria-pressed", "false");
    after.seek(time);
  };

  const marks = all(".mark");
  const showFrame = (id) => {
    const frame = report.frames[indexOf(id)];
    if (frame.time === null) return;
    for (const mark of marks) mark.classList.toggle("here", mark.dataset.frame === String(id));
    goTo(frame.time);
  };
  marks.forEach((mark, index) => {
    mark.addEventListener("click", () => showFrame(mark.dataset.frame));
    mark.addEventListener("keydown", (event) => {
      if (event.key === "Enter" || event.key === " ") { event.preventDefault(); showFrame(mark.dataset.frame); }
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (step) { event.preventDefault(); marks[(index + step + marks.length) % marks.length].focus(); }
    });
  });
  one("#stand").addEventListener("click", () => {
    inspector.close();
    showFrame(report.frames[current].id);
    stage.scrollIntoView({ block: "center" });
  });
  window.reportStage = { get before() { return before; }, get after() { return after; } };
}
