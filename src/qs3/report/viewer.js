"use strict";
// A canvas for each domain shows one cloud of the chosen class; all turn together.
(() => {
  const holder = document.getElementById("viewer");
  if (!holder) return;
  const select = holder.querySelector("select");
  let yaw = 0.5, pitch = 0.35, at = 0, waiting = false;
  const columns = [...holder.querySelectorAll("figure")].map((figure) => ({
    name: figure.dataset.domain,
    canvas: figure.querySelector("canvas"),
    caption: figure.querySelector("figcaption"),
    items: [...figure.querySelectorAll("i")],
    points: null,
  }));

  // A cloud is decoded when it is its turn: two hundred at once would take a phone long.
  function decode(item) {
    const bytes = Uint8Array.from(atob(item.dataset.points), (c) => c.charCodeAt(0));
    const view = new DataView(bytes.buffer), points = [];
    const read = (i) => view.getInt16(2 * i, true) / 32767;
    for (let i = 0; i < bytes.length / 2; i += 3) points.push([read(i), read(i + 1), read(i + 2)]);
    return points;
  }

  function show() {
    const name = select.options[select.selectedIndex].textContent;
    for (const column of columns) {
      const own = column.items.filter((item) => item.dataset.class === select.value);
      const row = own.length ? ((at % own.length) + own.length) % own.length : 0;
      column.points = own.length ? decode(own[row]) : null;
      const note = own.length && own[row].dataset.note;
      column.caption.textContent = own.length ? `${name} ${row + 1} of ${own.length}${note ? `. ${note}` : ""}` : `no ${name}`;
      column.canvas.setAttribute("aria-label", `${column.name}: ${column.caption.textContent}; can be turned`);
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
    requestAnimationFrame(() => { waiting = false; columns.forEach(draw); });
  }

  // Colour by height, from violet to green, lighter with distance.
  const colour = (share, far) => `hsl(${Math.round(275 - 165 * share)} 55% ${Math.round(30 + 18 * share + 20 * far)}%)`;

  function draw({ canvas, points }) {
    const size = Math.round(canvas.clientWidth * (window.devicePixelRatio || 1));
    if (!size) return;
    if (canvas.width !== size) canvas.width = canvas.height = size;
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, size, size);
    if (!points) return;
    const heights = points.map((p) => p[2]), low = Math.min(...heights), span = Math.max(...heights) - low || 1;
    const ca = Math.cos(yaw), sa = Math.sin(yaw), ce = Math.cos(pitch), se = Math.sin(pitch);
    const seen = points.map(([x, y, z]) => {
      const right = x * ca + y * sa, back = y * ca - x * sa;
      return { right, up: back * se + z * ce, near: z * se - back * ce, share: (z - low) / span };
    });
    seen.sort((a, b) => a.near - b.near);
    for (const { right, up, near, share } of seen) {
      pen.fillStyle = colour(share, (1 - near) / 2);
      pen.beginPath();
      pen.arc(size * (0.5 + 0.46 * right), size * (0.5 - 0.46 * up), Math.max(1.5, size / 130), 0, 6.2832);
      pen.fill();
    }
  }

  for (const { canvas } of columns) {
    canvas.addEventListener("pointerdown", (e) => canvas.setPointerCapture(e.pointerId));
    canvas.addEventListener("pointermove", (e) => { if (e.buttons) turn(e.movementX * 0.012, e.movementY * 0.012); });
    canvas.addEventListener("keydown", (e) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key];
      if (step) { turn(...step); e.preventDefault(); }
    });
  }
  for (const button of holder.querySelectorAll("button")) {
    button.addEventListener("click", () => { at += Number(button.dataset.step); show(); });
  }
  select.addEventListener("change", () => { at = 0; show(); });
  window.addEventListener("resize", redraw);
  holder.hidden = false;
  show();
})();
