"use strict";
// Each tab has columns of clouds; a canvas a column shows one of them, and all turn together.
(() => {
  const holder = document.getElementById("viewer");
  if (!holder) return;
  const panels = [...holder.querySelectorAll("[role=tabpanel]")].map(panelOf);
  const tabs = [...holder.querySelectorAll("[role=tab]")];
  let yaw = 0.5, pitch = 0.35, waiting = false, open = 0;

  function panelOf(root) {
    const select = root.querySelector("select");
    const columns = [...root.querySelectorAll("figure")].map((figure) => {
      const canvas = figure.querySelector("canvas");
      canvas.addEventListener("pointerdown", (e) => canvas.setPointerCapture(e.pointerId));
      canvas.addEventListener("pointermove", (e) => {
        if (e.buttons) turn(e.movementX * 0.012, e.movementY * 0.012);
      });
      canvas.addEventListener("keydown", (e) => {
        const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key];
        if (step) { turn(step[0], step[1]); e.preventDefault(); }
      });
      const items = [...figure.querySelectorAll("i")];
      return { name: figure.dataset.domain, canvas, items, caption: figure.querySelector("figcaption"), cloud: null };
    });
    const names = [...select.options].slice(1).map((option) => option.textContent);
    const panel = { root, select, columns, names, paired: "paired" in root.dataset, at: 0 };
    for (const button of root.querySelectorAll("button")) {
      button.addEventListener("click", () => show(panel, panel.at + Number(button.dataset.step)));
    }
    select.addEventListener("change", () => show(panel, 0));
    return panel;
  }

  // What the buttons step through: an item of each column. Where columns are pairs, the rows as
  // they stand; else class by class, and the column with fewer clouds begins anew.
  function steps({ select, columns, names, paired }) {
    const chosen = (kind) => select.value === "" || Number(select.value) === kind;
    const kindOf = (item) => Number(item.dataset.class);
    if (paired) {
      return columns[0].items.flatMap((item, row) => chosen(kindOf(item)) ? [columns.map((c) => [c.items[row]])] : []);
    }
    return names.flatMap((_, kind) => {
      if (!chosen(kind)) return [];
      const own = columns.map((column) => column.items.filter((item) => kindOf(item) === kind));
      const most = Math.max(...own.map((items) => items.length));
      return Array.from({ length: most }, (_, number) => own.map((items) => items.length
        ? [items[number % items.length], ` ${(number % items.length) + 1} of ${items.length}`]
        : [null, `no ${names[kind]}`]));
    });
  }

  // Clouds are decoded when it is their turn: two hundred of them at once would take a phone long.
  function decode(item) {
    const bytes = Uint8Array.from(atob(item.dataset.points), (c) => c.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    const points = new Float32Array(bytes.length / 2);
    for (let i = 0; i < points.length; i++) points[i] = view.getInt16(2 * i, true) / 32767;
    const order = Uint32Array.from({ length: points.length / 3 }, (_, i) => i);
    let low = Infinity, high = -Infinity, wide = 0, reach = 1e-6;
    for (const i of order) {
      const z = points[3 * i + 2], off = Math.hypot(points[3 * i], points[3 * i + 1]);
      low = Math.min(low, z);
      high = Math.max(high, z);
      wide = Math.max(wide, off);
      reach = Math.max(reach, off, 0.94 * Math.abs(z) + 0.34 * off);  // as seen at first
    }
    // Squares of the ground: 1, 2 or 5 times a power of ten, in the unit of the data.
    const radius = Number(item.dataset.radius), power = 10 ** Math.floor(Math.log10(0.6 * radius));
    const square = Math.max(...[1, 2, 5].map((s) => s * power).filter((s) => s <= 0.6 * radius));
    return { points, order, near: new Float32Array(order.length), low, span: high - low || 1, wide, reach, square, cell: square / radius };
  }

  function show(panel, place) {
    const all = steps(panel), output = panel.root.querySelector("output");
    panel.at = all.length ? (place + all.length) % all.length : 0;
    output.textContent = all.length ? `${panel.at + 1} of ${all.length}` : "none of this class";
    panel.columns.forEach((column, index) => {
      const [item, said] = all.length ? all[panel.at][index] : [null, ""];
      column.cloud = item ? decode(item) : null;
      column.caption.textContent = item
        ? `${panel.names[Number(item.dataset.class)]}${said || ""}${item.dataset.note ? `. ${item.dataset.note}` : ""}. Squares of ${Number(column.cloud.square.toPrecision(3))}`
        : said;
      column.canvas.setAttribute("aria-label", `${column.name}: ${column.caption.textContent}; can be turned`);
    });
    redraw();
  }

  function turn(x, y) {
    yaw -= x;
    pitch = Math.max(-1.57, Math.min(1.57, pitch + y));
    redraw();
  }

  function redraw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; panels[open].columns.forEach(draw); });
  }

  // Colour by height: stations of the viridis map but for its light end, faded with distance.
  const STATIONS = [[68, 1, 84], [64, 67, 135], [41, 120, 142], [34, 167, 132], [122, 209, 81]];
  function colour(share, far) {
    const at = Math.min(3.999, 4 * share), low = Math.floor(at), part = at - low;
    const mix = (k) => {
      const value = STATIONS[low][k] * (1 - part) + STATIONS[low + 1][k] * part;
      return Math.round(value + (255 - value) * far);
    };
    return `rgb(${mix(0)},${mix(1)},${mix(2)})`;
  }

  function draw({ canvas, cloud }) {
    const ratio = window.devicePixelRatio || 1, size = Math.round(canvas.clientWidth * ratio);
    if (!size) return;
    if (canvas.width !== size) canvas.width = canvas.height = size;
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, size, size);
    if (!cloud) return;
    const { points, order, near, low, span, wide, reach, cell } = cloud;
    const scale = size * 0.46 / reach, dot = Math.max(1.5, size / 130);
    const ca = Math.cos(yaw), sa = Math.sin(yaw), ce = Math.cos(pitch), se = Math.sin(pitch);
    const place = (x, y, z) => [size / 2 + scale * (x * ca + y * sa), size / 2 - scale * ((y * ca - x * sa) * se + z * ce)];
    pen.strokeStyle = "#d0d0d0";
    pen.lineWidth = ratio;
    pen.beginPath();
    const count = Math.ceil(wide / cell), end = count * cell;
    for (let i = -count; i <= count; i++) {
      pen.moveTo(...place(i * cell, -end, low)); pen.lineTo(...place(i * cell, end, low));
      pen.moveTo(...place(-end, i * cell, low)); pen.lineTo(...place(end, i * cell, low));
    }
    pen.stroke();
    for (let i = 0; i < near.length; i++) {
      near[i] = (points[3 * i] * sa - points[3 * i + 1] * ca) * ce + points[3 * i + 2] * se;
    }
    order.sort((a, b) => near[a] - near[b]);
    for (const i of order) {
      const z = points[3 * i + 2], [x, y] = place(points[3 * i], points[3 * i + 1], z);
      pen.fillStyle = colour((z - low) / span, 0.15 * (1 - near[i]));
      pen.beginPath();
      pen.arc(x, y, dot, 0, 6.2832);
      pen.fill();
    }
  }

  function choose(index) {
    open = index;
    tabs.forEach((tab, i) => {
      tab.setAttribute("aria-selected", String(i === index));
      tab.tabIndex = i === index ? 0 : -1;
      panels[i].root.hidden = i !== index;
    });
    redraw();
  }
  tabs.forEach((tab, index) => {
    tab.addEventListener("click", () => choose(index));
    tab.addEventListener("keydown", (e) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[e.key];
      if (!step) return;
      choose((index + step + tabs.length) % tabs.length);
      tabs[open].focus();
    });
  });
  window.addEventListener("resize", redraw);
  holder.hidden = false;
  panels.forEach((panel) => show(panel, 0));
  choose(0);
})();
