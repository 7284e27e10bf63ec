// Each scan is drawn with the edges of its CAD; all turn together. Chosen classes become a CSV.
(() => {
  const scans = [...document.querySelectorAll(".scan")].map((box) => ({
    box, canvas: box.querySelector("canvas"), select: box.querySelector("select"), shown: false,
  }));
  const angles = { yaw: 0, pitch: 0 };
  turnTogether(scans.map(({ canvas }) => canvas).filter(Boolean), angles, () => {
    for (const scan of scans) if (scan.shown) draw(scan);
  });

  function draw(scan) {
    const { canvas, box } = scan, { pen, size } = penOf(canvas);
    if (!size) return;
    scan.points ??= decode(box.dataset.points);
    scan.edges ??= decode(box.dataset.edges);
    const ca = Math.cos(angles.yaw), sa = Math.sin(angles.yaw);
    const ce = Math.cos(angles.pitch), se = Math.sin(angles.pitch);
    const place = ([x, y, z]) => {
      const right = x * ca + z * sa, near = z * ca - x * sa;
      return [size * (0.5 + 0.48 * right), size * (0.5 - 0.48 * (y * ce - near * se)), y * se + near * ce];
    };
    const dot = Math.max(1.2, size / 170);
    for (const [x, y, near] of scan.points.map(place).sort((a, b) => a[2] - b[2])) {
      pen.fillStyle = `hsl(${Math.round(250 - 60 * near)} 55% ${Math.round(55 - 18 * near)}%)`;
      pen.fillRect(x - dot, y - dot, 2 * dot, 2 * dot);
    }
    pen.strokeStyle = "lost" in box.dataset ? "#888888" : "#cc3311";
    pen.lineWidth = Math.max(1, size / 400);
    pen.beginPath();
    for (let i = 0; i < scan.edges.length; i += 2) {
      const [a, b] = [place(scan.edges[i]), place(scan.edges[i + 1])];
      pen.moveTo(a[0], a[1]);
      pen.lineTo(b[0], b[1]);
    }
    pen.stroke();
    bar(pen, size, Number(box.dataset.scale));
  }

  // A bar of 1, 2 or 5 times a power of ten millimetres.
  function bar(pen, size, radius) {
    if (!radius) return;
    const room = 0.3 * 2 * radius, power = 10 ** Math.floor(Math.log10(room));
    const length = [5, 2, 1].map((step) => step * power).find((step) => step <= room) || power;
    const wide = (0.48 * size * length) / radius, y = size - 0.04 * size;
    pen.fillStyle = "#333333";
    pen.fillRect(0.04 * size, y, wide, Math.max(2, size / 160));
    pen.font = `${Math.round(size / 20)}px sans-serif`;
    pen.fillText(`${Number(length.toPrecision(2))} mm`, 0.06 * size + wide, y + size / 60);
  }

  // Pictures are drawn when they come into view: hundreds at once would take a phone long.
  const watcher = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const scan = scans.find(({ canvas }) => canvas === entry.target);
      scan.shown = entry.isIntersecting;
      if (scan.shown) draw(scan);
    }
  }, { rootMargin: "300px" });
  for (const { canvas } of scans) if (canvas) watcher.observe(canvas);

  const filter = document.getElementById("filter");
  filter.addEventListener("change", () => {
    const [kind, number] = filter.value.split(":");
    for (const { box } of scans) {
      box.hidden = kind === "doubt" ? !box.classList.contains("doubt") : kind === "class" && box.dataset.class !== number;
    }
  });

  // No spreadsheet may compute a name: text that begins as a formula gets an apostrophe.
  function cell(text) {
    const safe = /^\s*[-+=@]/.test(text) && Number.isNaN(Number(text)) ? `'${text}` : text;
    return /[",\r\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
  }

  const save = document.getElementById("save"), chosen = document.getElementById("chosen");
  const labelled = () => scans.filter(({ select }) => select && select.value);
  function tell() {
    const count = labelled().length;
    save.disabled = !count;
    chosen.textContent = count === 1 ? "1 scan has a label." : `${count} scans have a label.`;
  }
  for (const { box, select } of scans) {
    select?.addEventListener("change", () => {
      box.classList.toggle("labelled", Boolean(select.value));
      tell();
    });
  }
  if (labelled().length) tell();  // labels that were learnt
  save.addEventListener("click", () => {
    const lines = labelled().map(({ box, select }) => `${cell(box.dataset.file)},${cell(select.value)}`);
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([["file,class", ...lines, ""].join("\r\n")], { type: "text/csv" }));
    link.download = "labels.csv";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  });
})();
