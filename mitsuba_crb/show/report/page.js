// What a report's page does: shows pictures with the values under the pointer, the view of the world, charts.
"use strict";
(() => {
  const report = JSON.parse(document.getElementById("report-data").textContent);
  const root = document.documentElement;
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const plots = [];

  // ---- light and dark

  const themes = ["auto", "light", "dark"];
  const themeWords = { auto: "as the system", light: "light", dark: "dark" };
  const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();

  function themed(axes) {
    const [text, muted, grid] = [colour("--text"), colour("--muted"), colour("--line")];
    const changes = {
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      "font.color": text,
      "font.family": "system-ui, sans-serif",
      "font.size": 12,
      "modebar.bgcolor": "rgba(0,0,0,0)",
      "modebar.color": muted,
      "modebar.activecolor": colour("--accent"),
    };
    for (const axis of axes) Object.assign(changes, { [`${axis}.gridcolor`]: grid, [`${axis}.color`]: muted, [`${axis}.linecolor`]: grid });
    return changes;
  }

  // plotly's "a.b" keys, in a layout that is not drawn yet: each drawing of the world takes long
  function within(layout, changes) {
    for (const [path, value] of Object.entries(changes)) {
      const keys = path.split(".");
      const last = keys.pop();
      let place = layout;
      for (const key of keys) place = place[key] ??= {};
      place[last] = value;
    }
    return layout;
  }

  function paint() {
    for (const [element, axes] of plots) {
      const named = element.data.flatMap((trace, index) => (trace.mode === "text" ? [index] : []));
      Plotly.update(element, named.length ? { "textfont.color": colour("--text") } : {}, themed(axes), named);
    }
  }

  const themeButton = document.getElementById("theme");
  themeButton.addEventListener("click", () => {
    const next = themes[(themes.indexOf(root.dataset.theme) + 1) % themes.length];
    root.dataset.theme = next;
    themeButton.textContent = `Theme: ${themeWords[next]}`;
    paint();
  });
  dark.addEventListener("change", paint);

  // ---- pictures and the values under the pointer

  const codesOf = (text) => {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    return Uint16Array.from({ length: bytes.length / 2 }, (_, k) => view.getUint16(2 * k, true));
  };
  const floatsOf = (text) => {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    return new Float32Array(bytes.buffer);
  };
  const written = (value, digits = 4) => Number(value.toPrecision(digits)).toString().replace("-", "−");

  function valueAt(grid, column, row, channel) {
    grid.decoded ??= codesOf(grid.codes);
    const code = grid.decoded[(row * grid.width + column) * grid.channels.length + channel];
    if (code === 65535) return null;
    if (code === 65534) return 0;
    const value = grid.low + code * grid.step;
    return grid.log ? Math.exp(value) : value;
  }

  function wordsAt(layer, column, row) {
    const grid = layer.grid;
    const values = grid.channels.map((name, channel) => [name, valueAt(grid, column, row, channel)]);
    if (values.some(([, value]) => value === null)) return "not measured";
    if (grid.log && values[0][1] === 0) return `not above the noise [${grid.unit}]`;
    return `${values.map(([name, value]) => `${name} ${written(value)}`.trim()).join(", ")} [${grid.unit}]`;
  }

  function viewer(element) {
    const layers = report.images[element.dataset.key];
    const label = element.dataset.label;
    const picture = element.querySelector(".picture");
    const image = picture.querySelector("img");
    const cross = picture.querySelector(".cross");
    const readout = element.querySelector(".readout");
    const chooser = element.querySelector("select");
    const bar = element.querySelector(".bar");
    const about = element.querySelector(".about");
    let current = 0;
    let cell = null;

    function show(index) {
      current = (index + layers.length) % layers.length;
      const layer = layers[current];
      image.src = layer.png;
      image.alt = `${label}: ${layer.name}, ${layer.about}`;
      picture.style.aspectRatio = `${layer.size[0]} / ${layer.size[1]}`;
      about.textContent = layer.about;
      if (chooser) chooser.value = String(current);
      bar.hidden = !layer.bar;
      if (layer.bar) {
        const stripe = document.createElement("i");
        stripe.style.background = `linear-gradient(to right, ${layer.bar.colours.join(", ")})`;
        const low = document.createElement("span");
        const high = document.createElement("span");
        low.textContent = `${layer.bar.log ? "≤ " : ""}${written(layer.bar.low, 2)}`;
        high.textContent = `${written(layer.bar.high, 2)} ${layer.grid.unit}${layer.bar.log ? ", logarithmic" : ""}`;
        bar.replaceChildren(low, stripe, high);
      }
      if (cell) point(...cell);
    }

    function point(column, row) {
      const { grid, size } = layers[current];
      column = Math.min(Math.max(column, 0), grid.width - 1);
      row = Math.min(Math.max(row, 0), grid.height - 1);
      cell = [column, row];
      const block = Math.ceil(size[0] / grid.width);
      const [x, y] = [column * block, row * block];
      const where = block === 1 ? `pixel (${x}, ${y})` : `pixels from (${x}, ${y}) to (${Math.min(x + block, size[0]) - 1}, ${Math.min(y + block, size[1]) - 1})`;
      readout.textContent = `${layers[current].name} at ${where}: ${wordsAt(layers[current], column, row)}`;
      cross.hidden = false;
      Object.assign(cross.style, {
        left: `${(100 * x) / size[0]}%`, top: `${(100 * y) / size[1]}%`,
        width: `max(6px, ${(100 * block) / size[0]}%)`, height: `max(6px, ${(100 * block) / size[1]}%)`,
      });
    }

    picture.addEventListener("pointermove", (event) => {
      const box = picture.getBoundingClientRect();
      const { grid, size } = layers[current];
      const block = Math.ceil(size[0] / grid.width);
      point(
        Math.floor((((event.clientX - box.left) / box.width) * size[0]) / block),
        Math.floor((((event.clientY - box.top) / box.height) * size[1]) / block),
      );
    });
    picture.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      const far = event.shiftKey ? 10 : 1;
      if (event.key in steps) {
        const { grid } = layers[current];
        const [column, row] = cell ?? [Math.floor(grid.width / 2), Math.floor(grid.height / 2)];
        point(column + far * steps[event.key][0], row + far * steps[event.key][1]);
      } else if (event.key === "PageDown") show(current + 1);
      else if (event.key === "PageUp") show(current - 1);
      else return;
      event.preventDefault();
    });
    chooser?.addEventListener("change", () => show(Number(chooser.value)));
    for (const button of element.querySelectorAll(".step")) {
      button.addEventListener("click", () => show(current + Number(button.dataset.step)));
    }
    show(0);
    return { show };
  }

  const viewers = {};
  for (const element of document.querySelectorAll(".viewer")) viewers[element.dataset.key] = viewer(element);

  // ---- charts

  const settings = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["sendDataToCloud", "resetCameraLastSave3d", "tableRotation", "toImage"] };
  for (const element of document.querySelectorAll("[data-chart]")) {
    const { data, layout } = report.charts[element.dataset.chart].figure;
    const axes = ["xaxis", "yaxis"];
    Plotly.newPlot(element, data, within(layout, themed(axes)), { ...settings, displayModeBar: false });
    plots.push([element, axes]);
    element.on("plotly_click", (event) => {
      const place = event.points[0]?.customdata?.[0];
      if (place !== undefined) choose(place);
    });
  }

  // ---- the world

  const space = document.getElementById("space");
  const world = report.space;
  let factor = world?.factor ?? 1;
  let eyes = null; // the camera as plotly has it
  let frustum = -1; // the trace of the chosen pose

  const sum = (a, b, t = 1) => a.map((value, k) => value + t * b[k]);
  const dot = (a, b) => a.reduce((total, value, k) => total + value * b[k], 0);
  const cross3 = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));
  const list = (point) => [point.x, point.y, point.z];
  const point3 = ([x, y, z]) => ({ x, y, z });
  const inView = (place) => place.map((value, k) => (value - world.centre[k]) / world.extent);

  function turned() {
    const eye = list(eyes.eye);
    const shown = { indices: [], visible: [] };
    for (const group of world.facing) {
      const towards = sum(eye, inView(group.place), -1);
      const visible = Math.hypot(...group.normal) < 0.2 || dot(towards, group.normal) > 0;
      if (group.visible === visible) continue;
      group.visible = visible;
      shown.indices.push(group.trace);
      shown.visible.push(visible);
    }
    return shown;
  }

  function hideWhatTurnsAway() {
    const { indices, visible } = turned();
    if (indices.length) Plotly.restyle(space, { visible }, indices);
  }

  function look(camera) {
    eyes = camera;
    const { indices, visible } = turned();
    Plotly.update(space, indices.length ? { visible } : {}, { "scene.camera": camera }, indices);
  }

  function scale() {
    for (const each of world.scaled) {
      each.c ??= floatsOf(each.centres);
      each.d ??= floatsOf(each.offsets);
      const axes = [0, 1, 2].map((axis) => Float32Array.from({ length: each.c.length / 3 }, (_, k) => each.c[3 * k + axis] + factor * each.d[3 * k + axis]));
      Plotly.restyle(space, { x: [axes[0]], y: [axes[1]], z: [axes[2]] }, [each.trace]);
    }
    say();
  }

  function say() {
    const said = document.getElementById("factor-said");
    if (said) said.textContent = factor === 1 ? "as large as they are" : `${written(factor)} times as large as they are`;
  }

  const columnOf = (pose, k) => [pose[0][k], pose[1][k], pose[2][k]];

  function throughCamera(sight) {
    const eye = inView(columnOf(sight.pose, 3));
    const forward = columnOf(sight.pose, 2);
    return { eye: point3(eye), center: point3(sum(eye, forward, 0.3)), up: point3(columnOf(sight.pose, 1)) };
  }

  function closeUp(sight) {
    const centre = inView(columnOf(sight.pose, 3));
    const away = sum(sum(list(world.first.eye), [0, 0, 0]), [0, 0, 0]);
    return { eye: point3(sum(centre, unit(away), 0.35)), center: point3(centre), up: point3(world.up) };
  }

  function fromAbove() {
    const forward = columnOf(world.sights[chosen ?? 0].pose, 2);
    const level = sum(forward, world.up, -dot(forward, world.up));
    const up = Math.hypot(...level) > 0.2 ? unit(level) : unit(cross3(world.up, [0.3, 0.9, 0.4]));
    return { eye: point3(world.up.map((value) => 1.5 * value)), center: point3([0, 0, 0]), up: point3(up) };
  }

  function turn(across, over, nearer) {
    const centre = list(eyes.center);
    const up = unit(list(eyes.up));
    let arm = sum(list(eyes.eye), centre, -1);
    const about = (vector, axis, angle) => {
      const [c, s] = [Math.cos(angle), Math.sin(angle)];
      return sum(sum(vector.map((value) => c * value), cross3(axis, vector), s), axis, (1 - c) * dot(axis, vector));
    };
    if (across) arm = about(arm, up, across);
    if (over) {
      const tilted = about(arm, unit(cross3(up, arm)), over);
      if (Math.abs(dot(unit(tilted), up)) < 0.985) arm = tilted;
    }
    look({ ...eyes, eye: point3(sum(centre, arm, nearer)), center: point3(centre), up: point3(up) });
  }

  let chosen = null;
  function choose(index) {
    if (!world?.sights[index]) return;
    chosen = index;
    for (const button of document.querySelectorAll("[data-pose]")) {
      const own = Number(button.dataset.pose) === index;
      button.setAttribute("aria-pressed", String(own));
      button.closest("tr").classList.toggle("chosen", own);
    }
    const layer = report.pictured?.indexOf(index) ?? -1;
    if (layer >= 0) viewers.path?.show(layer);
    const { pose, corners } = world.sights[index];
    const apex = columnOf(pose, 3);
    const size = Math.max(...corners.map((corner) => Math.hypot(...corner)));
    const ends = corners.map((corner) => apex.map((value, k) => value + (1.6 * world.reach / size) * dot(pose[k].slice(0, 3), corner)));
    const gap = [null, null, null];
    const line = [apex, ends[0], ends[1], ends[2], ends[3], ends[0], gap, apex, ends[1], gap, apex, ends[2], gap, apex, ends[3]];
    const axes = [0, 1, 2].map((k) => line.map((place) => place[k]));
    if (frustum < 0) {
      frustum = space.data.length;
      Plotly.addTraces(space, { type: "scatter3d", mode: "lines", name: "chosen pose", hoverinfo: "skip", line: { color: "#db2777", width: 6 }, x: axes[0], y: axes[1], z: axes[2] });
    } else Plotly.restyle(space, { x: [axes[0]], y: [axes[1]], z: [axes[2]] }, [frustum]);
  }

  if (space && world) {
    const { data, layout } = world.figure;
    eyes = structuredClone(world.first);
    const axes = ["scene.xaxis", "scene.yaxis", "scene.zaxis"];
    const first = turned();
    first.indices.forEach((trace, k) => (data[trace].visible = first.visible[k]));
    for (const trace of data) if (trace.mode === "text") trace.textfont = { ...trace.textfont, color: colour("--text") };
    Plotly.newPlot(space, data, within(layout, themed(axes)), settings).then(() => {
      document.body.dataset.ready = "true";
    });
    plots.push([space, axes]);
    const moved = (event) => {
      const camera = event["scene.camera"] ?? space._fullLayout?.scene?.camera;
      if (camera?.eye) {
        eyes = { eye: { ...camera.eye }, center: { ...camera.center }, up: { ...camera.up } };
        hideWhatTurnsAway();
      }
    };
    space.on("plotly_click", (event) => {
      const place = event.points[0]?.customdata?.[0];
      if (place !== undefined) choose(place);
    });
    space.on("plotly_relayout", moved);
    space.on("plotly_relayouting", moved);
    const views = { first: () => world.first, camera: () => throughCamera(world.sights[chosen ?? 0]), top: fromAbove, close: () => closeUp(world.sights[chosen ?? 0]) };
    for (const button of document.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => look(structuredClone(views[button.dataset.view]())));
    }
    const slider = document.getElementById("factor");
    if (slider) {
      slider.value = String(world.factors.findIndex((value) => Math.abs(value / world.factor - 1) < 1e-6));
      const told = () => slider.setAttribute("aria-valuetext", `${factor} times as large`);
      slider.addEventListener("input", () => {
        factor = world.factors[Number(slider.value)];
        told();
        scale();
      });
      told();
      say();
    }
    space.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: [-0.12, 0, 0], ArrowRight: [0.12, 0, 0], ArrowUp: [0, -0.1, 0], ArrowDown: [0, 0.1, 0], "+": [0, 0, 0.88], "=": [0, 0, 0.88], "-": [0, 0, 1.13] };
      if (!(event.key in steps) || event.target !== space) return;
      const [across, over, nearer] = steps[event.key];
      turn(across, over, nearer || 1);
      event.preventDefault();
    });
  } else document.body.dataset.ready = "true";

  for (const button of document.querySelectorAll("[data-pose]")) {
    button.addEventListener("click", () => choose(Number(button.dataset.pose)));
  }
  document.querySelector("[data-copy]")?.addEventListener("click", async (event) => {
    const button = event.currentTarget;
    const text = document.querySelector(".command code");
    try {
      await navigator.clipboard.writeText(text.textContent);
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(text);
      button.textContent = "Selected";
    }
  });
})();
