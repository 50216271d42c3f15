// The final scene in 3D, next to a frame as filmed. The viewer and the scene are scripts, since a page that is opened
// from disk may not read files.
"use strict";
{
  const stage = one("#stage");
  const status = one("#status");
  const pane = one('[data-pane="scene"]');
  const { settings, antialias, step, rotations, views } = report.viewer;
  let viewer = null;
  let sceneUrl = "";
  let wanted = report.frames[timeline.index()].time ?? 0;

  const loadScript = (name) => new Promise((resolve, reject) => {
    if (window.packed?.[name]) { resolve(); return; } // the report is one file
    const script = Object.assign(document.createElement("script"), { src: `${name}.js`, onload: resolve });
    script.onerror = () => reject(new Error(`${name}.js is missing`));
    document.head.append(script);
  });

  // Loads a script that contains gzipped content in base64, and returns a URL of the content.
  const unpack = async (name, type) => {
    await loadScript(name);
    const bytes = Uint8Array.from(atob(window.packed[name]), (letter) => letter.charCodeAt(0));
    delete window.packed[name];
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return URL.createObjectURL(new Blob([await new Response(stream).arrayBuffer()], { type }));
  };

  const open = async () => {
    const module = await import(await unpack("viewer", "text/javascript"));
    const url = sceneUrl = await unpack("scene", "application/octet-stream");
    const save = one("#save");
    save.hidden = false;
    save.addEventListener("click", () => Object.assign(make("a"), { href: url, download: save.dataset.name }).click());
    const opened = await module.createViewer({
      container: one(".live", pane),
      settings,
      contentUrl: url,
      contentFilename: "scene.compressed.ply",
      renderer: new URLSearchParams(location.search).has("webgpu") ? "webgpu" : "webgl",
      ui: false,
      noanim: true,
      aa: antialias,
    });
    opened.state.inputEnabled = false; // the page uses the keyboard until the stage has the focus
    if (!opened.state.loaded) await new Promise((resolve) => opened.events.once("loaded:changed", resolve));
    return opened;
  };

  // The viewer keeps the horizon level. At a frame, and between frames, the camera has the rotation of the frames.
  const tilt = () => {
    const camera = viewer.app.root.findByName("camera");
    const [from, to] = [0, 1].map(() => camera.getRotation().clone());
    viewer.app.on("update", () => {
      if ("away" in stage.dataset) return;
      const at = wanted / step;
      from.set(...rotations[Math.floor(at)]);
      to.set(...rotations[Math.min(Math.ceil(at), rotations.length - 1)]);
      camera.setRotation(from.slerp(from, to, at % 1));
    });
  };

  const begin = async () => {
    try {
      viewer = await open();
      tilt();
      const start = views.find(({ name }) => name === "start");
      if (start) showView(start.time);
      else goTo(wanted);
      viewer.app.once("frameend", () => pane.classList.add("ready"));
      status.textContent = "";
    } catch (error) {
      status.textContent = "3D is not available in this browser. This is a still image.";
      console.warn(error);
    }
    document.documentElement.dataset.stage = viewer ? "ready" : "failed";
  };
  new IntersectionObserver((entries, observer) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    observer.disconnect();
    begin();
  }, { rootMargin: "200px" }).observe(stage);

  // -- input ------------------------------------------------------------------------------------------------
  stage.addEventListener("focusin", () => { if (viewer) viewer.state.inputEnabled = true; });
  stage.addEventListener("focusout", () => { if (viewer) viewer.state.inputEnabled = false; });
  stage.addEventListener("pointerdown", (event) => {
    if (event.target.id !== "wipe") stage.focus({ preventScroll: true });
  });
  // The frame as filmed belongs to its own camera only.
  const leave = () => { stop(); stage.dataset.away = ""; };
  for (const type of ["pointerdown", "wheel"]) pane.addEventListener(type, leave, { passive: true });
  stage.addEventListener("keydown", (event) => { if ("wasdqef".includes(event.key.toLowerCase())) leave(); });

  const setMode = (mode) => {
    stage.dataset.mode = mode;
    for (const button of all("#controls [data-mode]")) button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
  };
  for (const button of all("#controls [data-mode]")) button.addEventListener("click", () => setMode(button.dataset.mode));
  one("#wipe").addEventListener("input", (event) => stage.style.setProperty("--wipe", `${event.target.value}%`));
  if (matchMedia("(max-width: 44rem)").matches) setMode("wipe");

  // -- the camera -------------------------------------------------------------------------------------------
  const play = one('[data-act="play"]');
  let flight = 0; // request of the next picture of a flight along the path

  const stop = () => {
    cancelAnimationFrame(flight);
    flight = 0;
    play.setAttribute("aria-pressed", "false");
  };

  const seek = (time) => {
    wanted = time;
    delete stage.dataset.away;
    if (!viewer) return;
    viewer.state.animationPaused = true;
    viewer.seek(time); // and renders
  };

  const goTo = (time) => { stop(); seek(time); };

  // A view of the user is a key of the track behind those of the frames.
  const showView = (time) => { goTo(time); stage.dataset.away = ""; };
  for (const button of all("[data-view]")) {
    button.addEventListener("click", () => { if (viewer) showView(Number(button.dataset.view)); });
  }

  const placed = report.frames.filter((frame) => frame.time !== null);
  const fly = () => {
    const end = step * (placed.length - 1);
    const origin = (wanted >= end ? 0 : wanted) - performance.now() / 1000;
    const next = () => {
      const time = origin + performance.now() / 1000;
      if (time >= end) { stop(); return; }
      seek(time);
      timeline.select(report.frames.indexOf(placed[Math.round(time / step)]), false);
      flight = requestAnimationFrame(next);
    };
    play.setAttribute("aria-pressed", "true");
    flight = requestAnimationFrame(next);
  };

  const act = {
    play: () => (flight ? stop() : fly()),
    back: () => timeline.select(timeline.index()),
    all: () => { leave(); viewer.frameScene(); },
    full: () => (document.fullscreenElement ? document.exitFullscreen() : stage.requestFullscreen()),
  };
  for (const button of all("#controls [data-act]")) {
    button.addEventListener("click", () => { if (viewer) act[button.dataset.act]?.(); });
  }
  one("#stand").addEventListener("click", () => {
    inspector.close();
    timeline.select(current);
    stage.scrollIntoView({ block: "center" });
  });
  window.reportStage = { goTo, get viewer() { return viewer; }, get sceneUrl() { return sceneUrl; } };
}
