// Measuring in the 3D view: a click gives a point on a surface of the scene, two give a distance and a box.
// Points are in the world of the run. The viewer's is turned by 180 degrees about z.
"use strict";
{
  const stage = one("#stage");
  const panel = one("#measure");
  const button = one('[data-act="measure"]');
  const OTHERS = [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]; // largest component of a quaternion -> the others
  const turned = ({ x, y, z }) => [-x, -y, z]; // its own inverse
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const less = (a, b) => a.map((x, k) => x - b[k]);
  const text = (values) => values.map((x) => Number(x.toPrecision(4))).join(",");
  let splats = null;
  let points = [];
  let dots = [];

  // Reads the .compressed.ply of the page: centres, deviations, rotations and opacities.
  const decode = (buffer) => {
    const bytes = new Uint8Array(buffer);
    const header = new TextDecoder().decode(bytes.subarray(0, 4096)).split("end_header\n")[0];
    const [, chunks] = /element chunk (\d+)/.exec(header);
    const [, count] = /element vertex (\d+)/.exec(header);
    const ranges = header.split("element chunk")[1].split("element")[0].match(/property float (\w+)/g).map((x) => x.slice(15));
    const at = Object.fromEntries(ranges.map((name, k) => [name, k]));
    const view = new DataView(buffer, header.length + 11);
    const range = (chunk, name) => view.getFloat32(4 * (chunk * ranges.length + at[name]), true);
    const begin = 4 * chunks * ranges.length;
    const packed = (index, field) => view.getUint32(begin + 16 * index + 4 * field, true);
    const three = (chunk, value, names) => [[21, 2047], [11, 1023], [0, 2047]].map(([shift, most], k) => {
      const [low, high] = ["min", "max"].map((end) => range(chunk, `${end}_${names[k]}`));
      return low + ((high - low) * ((value >>> shift) & most)) / most;
    });
    const found = [];
    for (let k = 0; k < count; k++) {
      const chunk = k >> 8;
      const size = three(chunk, packed(k, 2), ["scale_x", "scale_y", "scale_z"]).map(Math.exp);
      found.push({
        centre: three(chunk, packed(k, 0), ["x", "y", "z"]), size, rotation: packed(k, 1), reach: 3 * Math.max(...size),
        opacity: (packed(k, 3) & 255) / 255,
      });
    }
    return found;
  };

  // The columns of the rotation matrix.
  const axes = (bits) => {
    const largest = bits >>> 30;
    const q = [0, 0, 0, 0];
    [20, 10, 0].forEach((shift, n) => { q[OTHERS[largest][n]] = (((bits >>> shift) & 1023) / 1023 - 0.5) * Math.SQRT2; });
    q[largest] = Math.sqrt(Math.max(0, 1 - q.reduce((sum, x) => sum + x * x, 0)));
    const [w, x, y, z] = q;
    return [
      [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ];
  };

  // Distance along the ray from `origin` at which half of the light is absorbed; null where little is.
  const depth = (origin, direction) => {
    const hits = [];
    for (const { centre, size, rotation, reach, opacity } of splats) {
      const to = less(centre, origin);
      const along = dot(to, direction);
      if (along <= 0 || dot(to, to) - along * along > reach * reach) continue;
      const own = axes(rotation);
      const [p, q] = [to, direction].map((vector) => own.map((axis, k) => dot(axis, vector) / Math.max(size[k], 1e-9)));
      const best = dot(p, q) / dot(q, q);
      const alpha = opacity * Math.exp(-0.5 * (dot(p, p) - best * dot(p, q)));
      if (best > 0 && alpha > 1 / 255) hits.push([best, alpha]);
    }
    hits.sort((a, b) => a[0] - b[0]);
    let left = 1;
    for (const [distance, alpha] of hits) {
      left *= 1 - alpha;
      if (left < 0.5) return distance;
    }
    return null;
  };

  const camera = () => window.reportStage.viewer.app.root.findByName("camera");

  const pick = async (x, y) => {
    splats ??= decode(await (await fetch(window.reportStage.sceneUrl)).arrayBuffer());
    const node = camera();
    const origin = turned(node.getPosition());
    const far = less(turned(node.camera.screenToWorld(x, y, node.camera.farClip)), origin);
    const direction = far.map((value) => value / Math.hypot(...far));
    const distance = depth(origin, direction);
    return distance === null ? null : origin.map((value, k) => value + distance * direction[k]);
  };

  // -- the text below the view ------------------------------------------------------------------------------
  const command = (options, verb = "export") => {
    const line = make("div", undefined, "command");
    const words = `${report.program}${verb} ${report.shellName} ${options}`;
    const copies = Object.assign(make("button", "Copy", "copy"), { type: "button" });
    copies.addEventListener("click", async () => { await copy(words); copies.textContent = "Copied"; });
    line.append(make("code", words), copies);
    return line;
  };

  // The pair of frames whose cameras are farthest from the first one: `export --metres` needs their distance.
  const scaled = (factor) => {
    const placed = report.frames.filter((frame) => frame.time !== null);
    const values = report.viewer.settings.animTracks[0].keyframes.values.position;
    const centres = placed.map((_, k) => values.slice(3 * k, 3 * k + 3));
    const apart = centres.map((centre) => Math.hypot(...less(centre, centres[0])));
    const last = apart.indexOf(Math.max(...apart));
    return `--metres ${placed[0].id}-${placed[last].id}=${(factor * apart[last]).toPrecision(6)}`;
  };

  const show = (missed = false) => {
    const parts = [make("p", missed ? "No surface there. Click another point." : points.length
      ? points.map((point, k) => `Point ${k + 1}: ${text(point)}`).join(" · ") : "Click a point of the scene, then another.")];
    if (points.length === 1) {
      const radius = 0.03 * Math.hypot(...less(points[0], turned(camera().getPosition())));
      parts.push(make("p", "Without what is there:", "soft"), command(`-o ${report.shellName}-clean.ply --drop sphere:${text([...points[0], radius])}`));
    } else if (points.length === 2) {
      const distance = Math.hypot(...less(points[0], points[1]));
      const [low, high] = ["min", "max"].map((end) => points[0].map((x, k) => Math[end](x, points[1][k])));
      const label = make("label", `Distance: ${distance.toPrecision(4)} units. True length, m: `);
      const input = label.appendChild(Object.assign(make("input"), { type: "number", min: 0, step: "any", id: "metres" }));
      const made = make("div");
      input.addEventListener("change", async () => {
        const metres = Number(input.value);
        if (!(metres > 0)) return;
        made.replaceChildren(command(`-o ${report.shellName}-metres.ply ${scaled(metres / distance)}`));
        await copy(one("code", made).textContent);
      });
      parts.push(label, made, make("p", "Only the box between the points:", "soft"), command(`-o ${report.shellName}-cut.ply --crop box:${text([...low, ...high])}`));
    }
    panel.replaceChildren(...parts);
    for (const mark of dots) mark.remove();
    dots = points.map((point) => {
      const mark = one(".live").appendChild(make("i", undefined, "mark"));
      return Object.assign(mark, { point });
    });
  };

  const follow = () => {
    const node = camera();
    const place = node.getPosition().clone();
    for (const mark of dots) {
      const [x, y, z] = mark.point;
      const seen = node.camera.worldToScreen(place.set(-x, -y, z));
      mark.hidden = !(seen.z > 0);
      Object.assign(mark.style, { left: `${seen.x}px`, top: `${seen.y}px` });
    }
  };

  let measures = false;
  button.addEventListener("click", () => {
    if (!window.reportStage.viewer) return;
    measures = !measures;
    button.setAttribute("aria-pressed", String(measures));
    if (measures) window.reportStage.viewer.app.on("update", follow);
    else window.reportStage.viewer.app.off("update", follow);
    stage.toggleAttribute("data-measures", measures);
    panel.hidden = !measures;
    stage.scrollIntoView({ block: "nearest" });
    points = [];
    show();
  });

  // The present view as an option of `cleargs report`: a page cannot store it.
  one('[data-act="keep"]').addEventListener("click", () => {
    if (!window.reportStage.viewer) return;
    const node = camera();
    const position = turned(node.getPosition());
    const target = position.map((value, k) => value + turned(node.forward)[k]);
    const label = make("label", "Name of the view (start: the first one): ");
    const input = label.appendChild(Object.assign(make("input"), { value: "start", id: "view-name" }));
    const made = make("div");
    const write = () => {
      const name = input.value.replaceAll("=", "").replaceAll("'", "’").trim() || "start";
      made.replaceChildren(command(`--view '${name}=${[...position, ...target].map((x) => x.toFixed(5)).join(",")}'`, "report"));
    };
    input.addEventListener("input", write);
    write();
    panel.hidden = false;
    panel.replaceChildren(label, made, make("p", "This command stores the view in the run, and writes the report again.", "soft"));
  });

  let pressed = null;
  const pane = one(".live");
  pane.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; }, { capture: true });
  pane.addEventListener("pointerup", async (event) => {
    if (!measures || !pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 4) return; // a drag
    // The viewer would turn its camera to the clicked point. It gets the end of the press, but no click.
    event.stopPropagation();
    const { pointerId, pointerType, button } = event;
    event.target.dispatchEvent(new PointerEvent("pointercancel", { pointerId, pointerType, button, bubbles: true }));
    const { left, top } = pane.getBoundingClientRect();
    const point = await pick(event.clientX - left, event.clientY - top);
    if (point) points = points.length === 2 ? [point] : [...points, point];
    show(!point);
  }, { capture: true });
  window.reportMeasure = { pick, get points() { return points; } };
}
