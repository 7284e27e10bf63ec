"use strict";
// Of both pages: points in a text, the pen of a canvas, and canvases that all turn together.
function decode(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const view = new DataView(bytes.buffer), points = [];
  const read = (i) => view.getInt16(2 * i, true) / 32767;
  for (let i = 0; i < bytes.length / 2; i += 3) points.push([read(i), read(i + 1), read(i + 2)]);
  return points;
}

// Of a canvas that has as many pixels as the screen shows of it, cleared.
function penOf(canvas) {
  const size = Math.round(canvas.clientWidth * (window.devicePixelRatio || 1));
  if (size && canvas.width !== size) canvas.width = canvas.height = size;
  const pen = canvas.getContext("2d");
  pen.clearRect(0, 0, size, size);
  return { pen, size };
}

// Dragging and the arrow keys change yaw and pitch. Returns what draws all, once in a frame.
function turnTogether(canvases, angles, draw) {
  let waiting = false;
  function redraw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(); });
  }

  function turn(x, y) {
    angles.yaw -= x;
    angles.pitch = Math.max(-1.57, Math.min(1.57, angles.pitch + y));
    redraw();
  }

  for (const canvas of canvases) {
    canvas.addEventListener("pointerdown", (e) => canvas.setPointerCapture(e.pointerId));
    canvas.addEventListener("pointermove", (e) => { if (e.buttons) turn(e.movementX * 0.012, e.movementY * 0.012); });
    canvas.addEventListener("keydown", (e) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key];
      if (step) { turn(...step); e.preventDefault(); }
    });
  }
  window.addEventListener("resize", redraw);
  return redraw;
}
