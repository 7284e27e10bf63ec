"use strict";
// Every canvas shows one cloud; all turn together, so that two domains are seen from one side.
(() => {
  const holder = document.getElementById("viewer");
  if (!holder) return;
  const clouds = [];
  let yaw = 0.5, pitch = 0.35, waiting = false;

  for (const canvas of holder.querySelectorAll("canvas")) {
    const bytes = Uint8Array.from(atob(canvas.dataset.points), (c) => c.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    const points = new Float32Array(bytes.length / 2);
    for (let i = 0; i < points.length; i++) points[i] = view.getInt16(2 * i, true) / 32767;
    const order = Uint32Array.from({ length: points.length / 3 }, (_, i) => i);
    let low = Infinity, high = -Infinity;
    for (const i of order) {
      low = Math.min(low, points[3 * i + 2]);
      high = Math.max(high, points[3 * i + 2]);
    }
    clouds.push({ canvas, points, order, near: new Float32Array(order.length), low, span: high - low || 1 });
    canvas.addEventListener("pointerdown", (e) => canvas.setPointerCapture(e.pointerId));
    canvas.addEventListener("pointermove", (e) => {
      if (e.buttons) turn(e.movementX * 0.012, e.movementY * 0.012);
    });
    canvas.addEventListener("keydown", (e) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key];
      if (step) { turn(step[0], step[1]); e.preventDefault(); }
    });
  }

  function turn(x, y) {
    yaw -= x;
    pitch = Math.max(-1.57, Math.min(1.57, pitch + y));
    redraw();
  }

  function redraw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; clouds.forEach(draw); });
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

  function draw({ canvas, points, order, near, low, span }) {
    const ratio = window.devicePixelRatio || 1, size = Math.round(canvas.clientWidth * ratio);
    if (!size) return;
    if (canvas.width !== size) canvas.width = canvas.height = size;
    const pen = canvas.getContext("2d"), scale = size * 0.46, dot = Math.max(2, size / 75);
    const ca = Math.cos(yaw), sa = Math.sin(yaw), ce = Math.cos(pitch), se = Math.sin(pitch);
    for (let i = 0; i < near.length; i++) {
      near[i] = (points[3 * i] * sa - points[3 * i + 1] * ca) * ce + points[3 * i + 2] * se;
    }
    order.sort((a, b) => near[a] - near[b]);
    pen.clearRect(0, 0, size, size);
    for (const i of order) {
      const x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
      const right = x * ca + y * sa, up = (y * ca - x * sa) * se + z * ce;
      pen.fillStyle = colour((z - low) / span, 0.3 * (1 - near[i]));
      pen.fillRect(size / 2 + scale * right - dot / 2, size / 2 - scale * up - dot / 2, dot, dot);
    }
  }

  if (!clouds.length) return;
  holder.hidden = false;
  window.addEventListener("resize", redraw);
  redraw();
})();
