"use strict";
// One canvas per map: a slider chooses the cycle, the pointer or a finger reads a value, arrow keys move the slider.
function decode(text, Type) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return new Type(bytes.buffer);
}
function drawMap(root) {
  const data = JSON.parse(root.querySelector("script").textContent);
  const canvas = root.querySelector("canvas"), slider = root.querySelector("input[type=range]");
  const readout = root.querySelector(".readout"), label = root.querySelector(".cycle-label");
  const quantity = root.querySelector("select"), scale = root.querySelector(".scale");
  const layers = {};
  for (const [name, layer] of Object.entries(data.layers)) layers[name] = { ...layer, values: decode(layer.values, Int16Array) };
  const context = canvas.getContext("2d"), cells = data.nx * data.ny;
  const picture = new ImageData(data.nx, data.ny), small = document.createElement("canvas");
  small.width = data.nx; small.height = data.ny;
  const value = (layer, cycle, cell) => {
    const stored = layer.values[cycle * cells + cell];
    return stored === -32768 ? NaN : layer.offset + layer.step * stored;
  };
  function place(x, y) {  // plan mm to canvas px; y of the plan grows upwards
    return [(x - data.x0) / (data.x1 - data.x0) * canvas.width, (1 - (y - data.y0) / (data.y1 - data.y0)) * canvas.height];
  }
  function draw() {
    const layer = layers[quantity.value], cycle = Number(slider.value);
    const span = layer.high - layer.low || 1;
    for (let row = 0; row < data.ny; row++) for (let column = 0; column < data.nx; column++) {
      const v = value(layer, cycle, row * data.nx + column), at = 4 * ((data.ny - 1 - row) * data.nx + column);
      if (Number.isNaN(v)) { picture.data.set([225, 229, 231, 255], at); continue; }
      const shade = Math.max(0, Math.min(255, Math.round((v - layer.low) / span * 255)));
      picture.data.set([...layer.palette[shade], 255], at);
    }
    small.getContext("2d").putImageData(picture, 0, 0);
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientWidth * ratio * (data.y1 - data.y0) / (data.x1 - data.x0));
    context.imageSmoothingEnabled = false;
    context.drawImage(small, 0, 0, canvas.width, canvas.height);
    context.font = `600 ${12 * ratio}px sans-serif`; context.textAlign = "center"; context.lineJoin = "round";
    for (const [colour, extra] of [["#1f2a30", 2], ["#ffffff", 0]]) {  // dark under light reads on every colour
      context.strokeStyle = context.fillStyle = colour; context.lineWidth = (1.5 + extra) * ratio; context.beginPath();
      data.line.forEach(([x, y], i) => { const [u, v] = place(x, y); if (i) context.lineTo(u, v); else context.moveTo(u, v); });
      context.stroke();
      data.line.forEach(([x, y], i) => {
        const [u, v] = place(x, y); context.beginPath(); context.arc(u, v, (2.5 + extra / 2) * ratio, 0, 7); context.fill();
        if (i && i < data.line.length - 1) return;
        if (extra) context.strokeText(String(i + 1), u, v - 8 * ratio); else context.fillText(String(i + 1), u, v - 8 * ratio);
      });
    }
    context.lineWidth = 1.5 * ratio;
    for (const spot of data.hotspots) {
      const [u, v] = place(spot.x_mm, spot.y_mm);
      context.strokeStyle = "#ffffff"; context.beginPath(); context.arc(u, v, 8 * ratio, 0, 7); context.stroke();
      context.strokeStyle = "#1f2a30"; context.beginPath(); context.arc(u, v, 9.5 * ratio, 0, 7); context.stroke();
    }
    label.textContent = data.cycles[cycle];
    const bar = scale.querySelector("canvas").getContext("2d");
    for (let i = 0; i < 256; i++) { bar.fillStyle = `rgb(${layer.palette[i]})`; bar.fillRect(i, 0, 1, 1); }
    scale.querySelector(".low").textContent = `${layer.low.toFixed(2)} ${layer.unit}`;
    scale.querySelector(".high").textContent = `${layer.high.toFixed(2)} ${layer.unit}`;
  }
  function read(event) {
    const box = canvas.getBoundingClientRect(), point = event.touches ? event.touches[0] : event;
    const column = Math.floor((point.clientX - box.left) / box.width * data.nx);
    const row = data.ny - 1 - Math.floor((point.clientY - box.top) / box.height * data.ny);
    if (column < 0 || row < 0 || column >= data.nx || row >= data.ny) return;
    const x = data.x0 + (column + 0.5) / data.nx * (data.x1 - data.x0), y = data.y0 + (row + 0.5) / data.ny * (data.y1 - data.y0);
    const parts = Object.values(layers).map((layer) => {
      const v = value(layer, Number(slider.value), row * data.nx + column);
      return Number.isNaN(v) ? `${layer.name}: not seen` : `${layer.name} ${v.toFixed(2)} ${layer.unit}`;
    });
    readout.textContent = `x ${x.toFixed(0)} mm, y ${y.toFixed(0)} mm: ${parts.join(", ")}`;
  }
  slider.addEventListener("input", draw); quantity.addEventListener("change", draw);
  window.addEventListener("resize", draw); window.addEventListener("beforeprint", draw);
  canvas.addEventListener("pointermove", read); canvas.addEventListener("touchstart", read, { passive: true });
  draw();
}
document.querySelectorAll(".map").forEach(drawMap);
window.addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((part) => { part.open = true; }));
