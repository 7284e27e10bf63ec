// A canvas for each domain shows one cloud of the chosen class; all turn together.
(() => {
  const holder = document.getElementById("viewer");
  if (!holder) return;
  const select = holder.querySelector("select");
  const angles = { yaw: 0.5, pitch: 0.35 };
  let at = 0;
  const columns = [...holder.querySelectorAll("figure")].map((figure) => ({
    name: figure.dataset.domain,
    canvas: figure.querySelector("canvas"),
    caption: figure.querySelector("figcaption"),
    items: [...figure.querySelectorAll("i")],
    points: null,
  }));

  const redraw = turnTogether(columns.map(({ canvas }) => canvas), angles, () => columns.forEach(draw));

  function show() {
    const name = select.options[select.selectedIndex].textContent;
    for (const column of columns) {
      const own = column.items.filter((item) => item.dataset.class === select.value);
      const row = own.length ? ((at % own.length) + own.length) % own.length : 0;
      // A cloud is decoded when it is its turn: two hundred at once would take a phone long.
      column.points = own.length ? decode(own[row].dataset.points) : null;
      const note = own.length && own[row].dataset.note;
      column.caption.textContent = own.length ? `${name} ${row + 1} of ${own.length}${note ? `. ${note}` : ""}` : `no ${name}`;
      column.canvas.setAttribute("aria-label", `${column.name}: ${column.caption.textContent}; can be turned`);
    }
    redraw();
  }

  // Colour by height, from violet to green, lighter with distance.
  const colour = (share, far) => `hsl(${Math.round(275 - 165 * share)} 55% ${Math.round(30 + 18 * share + 20 * far)}%)`;

  function draw({ canvas, points }) {
    const { pen, size } = penOf(canvas);
    if (!size || !points) return;
    const heights = points.map((p) => p[2]), low = Math.min(...heights), span = Math.max(...heights) - low || 1;
    const ca = Math.cos(angles.yaw), sa = Math.sin(angles.yaw);
    const ce = Math.cos(angles.pitch), se = Math.sin(angles.pitch);
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

  for (const button of holder.querySelectorAll("button")) {
    button.addEventListener("click", () => { at += Number(button.dataset.step); show(); });
  }
  select.addEventListener("change", () => { at = 0; show(); });
  holder.hidden = false;
  show();
})();
