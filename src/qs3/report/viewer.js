"use strict";
// A canvas a domain shows one cloud of the same class; all turn together, seen from one side.
(() => {
  const holder = document.getElementById("viewer");
  if (!holder) return;
  const select = holder.querySelector("select"), counter = holder.querySelector("output");
  const names = [...select.options].slice(1).map((option) => option.textContent);
  let yaw = 0.5, pitch = 0.35, waiting = false, at = 0;

  const domains = [...holder.querySelectorAll("figure")].map((figure) => {
    const canvas = figure.querySelector("canvas");
    canvas.addEventListener("pointerdown", (e) => canvas.setPointerCapture(e.pointerId));
    canvas.addEventListener("pointermove", (e) => {
      if (e.buttons) turn(e.movementX * 0.012, e.movementY * 0.012);
    });
    canvas.addEventListener("keydown", (e) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key];
      if (step) { turn(step[0], step[1]); e.preventDefault(); }
    });
    const items = names.map(() => []);
    for (const item of figure.querySelectorAll("i")) items[Number(item.dataset.class)].push(item);
    return { name: figure.dataset.domain, canvas, items, caption: figure.querySelector("figcaption"), cloud: null };
  });

  // What the buttons step through: class and number; the domain with fewer clouds begins anew.
  function steps() {
    const places = [];
    names.forEach((_, kind) => {
      if (select.value !== "" && Number(select.value) !== kind) return;
      const most = Math.max(...domains.map((domain) => domain.items[kind].length));
      for (let number = 0; number < most; number++) places.push([kind, number]);
    });
    return places;
  }

  // Clouds are decoded when it is their turn: two hundred of them at once would take a phone long.
  function decode(item) {
    const bytes = Uint8Array.from(atob(item.dataset.points), (c) => c.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    const points = new Float32Array(bytes.length / 2);
    for (let i = 0; i < points.length; i++) points[i] = view.getInt16(2 * i, true) / 32767;
    const order = Uint32Array.from({ length: points.length / 3 }, (_, i) => i);
    let low = Infinity, high = -Infinity;
    for (const i of order) {
      low = Math.min(low, points[3 * i + 2]);
      high = Math.max(high, points[3 * i + 2]);
    }
    return { points, order, near: new Float32Array(order.length), low, span: high - low || 1 };
  }

  function show(place) {
    const all = steps();
    at = (place + all.length) % all.length;
    const [kind, number] = all[at];
    counter.textContent = `${at + 1} of ${all.length}`;
    for (const domain of domains) {
      const own = domain.items[kind], item = own[number % own.length];
      domain.cloud = item ? decode(item) : null;
      domain.caption.textContent = item
        ? `${domain.name}: ${names[kind]} ${(number % own.length) + 1} of ${own.length}${item.dataset.note ? `. ${item.dataset.note}` : ""}`
        : `${domain.name}: no ${names[kind]}`;
      domain.canvas.setAttribute("aria-label", `${domain.caption.textContent}; can be turned`);
    }
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
    requestAnimationFrame(() => { waiting = false; domains.forEach(draw); });
  }

  // Colour by height: five stations of the viridis map, faded towards white with distance.
  const STATIONS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [200, 220, 50]];
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
    const pen = canvas.getContext("2d"), scale = size * 0.46, dot = Math.max(2, size / 110);
    pen.clearRect(0, 0, size, size);
    if (!cloud) return;
    const { points, order, near, low, span } = cloud;
    const ca = Math.cos(yaw), sa = Math.sin(yaw), ce = Math.cos(pitch), se = Math.sin(pitch);
    for (let i = 0; i < near.length; i++) {
      near[i] = (points[3 * i] * sa - points[3 * i + 1] * ca) * ce + points[3 * i + 2] * se;
    }
    order.sort((a, b) => near[a] - near[b]);
    for (const i of order) {
      const x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
      const right = x * ca + y * sa, up = (y * ca - x * sa) * se + z * ce;
      pen.fillStyle = colour((z - low) / span, 0.3 * (1 - near[i]));
      pen.fillRect(size / 2 + scale * right - dot / 2, size / 2 - scale * up - dot / 2, dot, dot);
    }
  }

  for (const button of holder.querySelectorAll("button")) {
    button.addEventListener("click", () => show(at + Number(button.dataset.step)));
  }
  select.addEventListener("change", () => show(0));
  window.addEventListener("resize", redraw);
  holder.hidden = false;
  show(0);
})();
