"use strict";
// Every chart is drawn when it comes near the window, the others while the browser is idle; on paper each is a drawing in SVG.
(() => {
  const figures = [...document.querySelectorAll("figure.chart")];
  const started = new Map(), roots = new Map();  // figure -> promise of its view, and the view once it is there
  function draw(figure) {
    if (!started.has(figure)) {
      const item = JSON.parse(figure.querySelector("script").textContent);
      started.set(figure, Bokeh.embed.embed_item(item).then((views) => {
        const view = [...views.roots][0];
        roots.set(figure, view);
        fit(figure, view);
        dress(figure, view, dark.matches);
        if (figure.querySelector(".controls")) steer(figure, view);
        return view;
      }));
    }
    return started.get(figure);
  }
  const plots = (view) => view.model.type === "Figure" ? [view] : view.child_views.flatMap(plots);

  // On a dark page lines and points turn their lightness and keep their hue (report.css); a map keeps the colours of its scale, and what
  // stands around it turns. Paper and saved pictures are white.
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const night = { "#1f2a30": "#e7ecee", "#566269": "#a9b5bb" };
  const day = Object.fromEntries(Object.entries(night).map(([light, other]) => [other, light]));
  function dress(figure, view, turned) {
    const colours = turned ? night : day, every = plots(view);
    const isMap = every.some((plot) => plot.model.renderers.some((part) => part.glyph?.type === "Image"));
    figure.classList.toggle("lines", !isMap);
    for (const { el, model } of every) {
      el.style.backgroundColor = turned ? "transparent" : "";
      model.background_fill_color = model.border_fill_color = turned ? null : "#ffffff";
      if (isMap) for (const part of [...model.left, ...model.right, ...model.above, ...model.below]) {
        for (const [name, value] of Object.entries(part.attributes)) {
          const other = /_color$/.test(name) && colours[String(value?.value ?? value).toLowerCase()];
          if (other) part[name] = other;
        }
      }
    }
  }
  const dressAll = (turned) => roots.forEach((view, figure) => dress(figure, view, turned));
  dark.addEventListener("change", () => dressAll(dark.matches));

  // A plan has millimetres of one length in both directions: its height follows the width that the page leaves it.
  const tallest = 340;
  function fit(figure, view) {
    figure.querySelector(".drawing").style.minHeight = 0;
    for (const { model, bbox } of plots(view)) for (const legend of model.above) {  // as many names in a line as there is room for
      if (legend.type !== "Legend" || !legend.items.length) continue;
      const widths = legend.items.map((item) => 34 + 5.7 * (item.label?.value ?? "").length), room = bbox.width - 40;
      const fitting = widths.reduce((all, one) => all + one) <= room ? widths.length : Math.floor(room / Math.max(...widths));
      legend.ncols = Math.max(1, Math.min(widths.length, fitting));
    }
    if (view.model.name !== "plan") return;
    figure.classList.add("plan");
    if (!view.frame.bbox.width) return;
    for (const part of view.model.renderers) if (part.name === "aside") part.visible = view.frame.bbox.width > 400;
    const { x_range, y_range } = view.model, ratio = Math.abs((y_range.end - y_range.start) / (x_range.end - x_range.start));
    view.model.frame_height = Math.round(Math.min(tallest, view.frame.bbox.width * ratio));
    view.model.height = null;
  }
  const fitAll = () => roots.forEach((view, figure) => fit(figure, view));
  window.addEventListener("resize", () => setTimeout(fitAll, 100));

  const near = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) { near.unobserve(entry.target); draw(entry.target); }
  }, { rootMargin: "600px" });
  figures.forEach((figure) => near.observe(figure));
  const idle = window.requestIdleCallback || ((work) => setTimeout(work, 50));
  function drawRest() {
    const next = figures.find((figure) => !started.has(figure) && figure.offsetParent);  // not what is folded away
    if (next) draw(next).then(() => idle(drawRest)); else document.documentElement.dataset.charts = "drawn";
  }
  window.addEventListener("load", () => idle(drawRest));

  function save(content, type, name) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([content], { type }));
    link.download = name; link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }
  function cell(value) {  // text that a spreadsheet would take for a formula gets an apostrophe
    if (typeof value === "number") return Number.isFinite(value) ? String(Number(value.toPrecision(7))) : "";
    const shown = String(value).replace(/[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]/g, " ");
    const text = /^[=+\-@\t\n＝＋－＠]/.test(shown) ? `'${shown}` : shown;
    return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  }
  function table(columns) {
    const headings = [...columns.keys()], values = [...columns.values()];
    const lines = [headings.map(cell).join(",")];
    for (let row = 0; row < (values[0] ?? []).length; row++) lines.push(values.map((column) => cell(column[row])).join(","));
    return `\ufeff${lines.join("\r\n")}\r\n`;
  }
  const actions = {
    zoom(figure, view, button) {
      const active = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", active);
      for (const plot of plots(view)) for (const tool of plot.model.toolbar.tools) {
        if (["PanTool", "WheelZoomTool"].includes(tool.type)) tool.active = active;
      }
    },
    reset(figure, view) { plots(view).forEach((plot) => plot.reset()); },
    async image(figure, view) {
      dress(figure, view, false);
      save(await view.export("png").to_blob(), "image/png", `${figure.id}.png`);
      dress(figure, view, dark.matches);
    },
    data(figure, view) {
      const columns = view.model.tags[0].data;
      save(table(columns instanceof Map ? columns : new Map(Object.entries(columns))), "text/csv;charset=utf-8", `${figure.id}.csv`);
    },
  };
  for (const figure of figures) figure.querySelector(".tools").addEventListener("click", async (event) => {
    const button = event.target.closest("button");
    if (button) actions[button.dataset.do](figure, await draw(figure), button);
  });

  function steer(figure, view) {  // the thermal map: quantity, cycle, play
    const plot = view.model, [, source, about] = plot.tags;
    const { scales, cycles } = about instanceof Map ? Object.fromEntries(about) : about;
    const property = (scale, name) => scale instanceof Map ? scale.get(name) : scale[name];
    const cells = plot.renderers.find((part) => part.name === "cells");
    const image = cells.data_source.data.image[0], bar = plot.below.find((part) => part.name === "bar");
    const reading = plot.toolbar.tools.find((tool) => tool.name === "reading"), columns = source.data;
    const layers = scales.map((scale) => {  // each cycle is kept as its difference to the one before, in 16 bits
      const name = property(scale, "name"), steps = (columns instanceof Map ? columns.get(name) : columns[name]).slice();
      for (let at = image.length; at < steps.length; at++) steps[at] += steps[at - image.length];
      return steps;
    });
    const controls = figure.querySelector(".controls"), drawing = figure.querySelector(".drawing");
    const menu = controls.querySelector("select"), slider = controls.querySelector("input"), play = controls.querySelector("button");
    function show() {
      const scale = (name) => property(scales[menu.selectedIndex], name), steps = layers[menu.selectedIndex];
      const start = Number(slider.value) * image.length;
      let least = Infinity, most = -Infinity;
      for (let at = 0; at < image.length; at++) {
        const step = steps[start + at];
        image[at] = step === -32768 ? NaN : step * scale("step");
        if (step !== -32768) { least = Math.min(least, image[at]); most = Math.max(most, image[at]); }
      }
      cells.glyph.color_mapper.setv({ low: scale("low"), high: scale("high"), palette: scale("palette") });
      cells.data_source.change.emit();
      const format = scale("decimals") ? `0.${"0".repeat(scale("decimals"))}` : "0", unit = scale("unit");
      bar.title = unit ? `${scale("name")} / ${unit}` : scale("name");
      reading.tooltips = [["x", "$x{0} mm"], ["y", "$y{0} mm"], [scale("name"), `@image{${format}} ${unit}`]];
      controls.querySelector("output").textContent = cycles[slider.value];
      const range = least <= most ? `${least.toFixed(scale("decimals"))} to ${most.toFixed(scale("decimals"))} ${unit}` : "not seen";
      drawing.setAttribute("aria-label", `Plan of the table in cycle ${cycles[slider.value]}: ${scale("name")} ${range}.`);
    }
    let running = 0;
    play.addEventListener("click", () => {
      if (running) { clearInterval(running); running = 0; } else {
        if (slider.value === slider.max) slider.value = 0;
        show();
        running = setInterval(() => {
          if (slider.value === slider.max) { play.click(); return; }
          slider.stepUp(); show();
        }, 250);
      }
      play.textContent = running ? "Stop" : "Play";
      play.setAttribute("aria-pressed", Boolean(running));
    });
    slider.addEventListener("input", show);
    menu.addEventListener("change", show);
  }

  // Paper: charts in the width that they have on A4, so that their text keeps its size; then each becomes a drawing in SVG.
  const flatter = 0.62, heights = new Map();
  const later = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));
  async function toPaper() {
    document.documentElement.classList.add("paper");
    for (const figure of figures) if (figure.offsetParent) await draw(figure);
    for (const view of roots.values()) for (const plot of plots(view)) {
      for (const axis of [...plot.model.left, ...plot.model.below]) if (axis.axis_label) axis.axis_label_text_font_size = "10px";
      // A plan or a picture keeps its proportions, a low chart below others most of its height.
      if (plot.model.height === null || plot.model.sizing_mode === "scale_width") continue;
      heights.set(plot.model, plot.model.height);
      plot.model.height = Math.round((plots(view).length > 2 ? 0.75 : flatter) * plot.model.height);
    }
    await later(300);
    fitAll();
    await later(400);
    freeze();
  }
  function toScreen() {
    document.documentElement.classList.remove("paper");
    for (const [model, height] of heights) model.height = height;
    heights.clear();
    thaw();
  }
  function freeze() {
    thaw();
    dressAll(false);
    for (const [figure, view] of roots) {
      const { width, height } = view.bbox;
      if (!width) continue;
      const drawing = view.export("svg", false).ctx.get_svg();
      drawing.setAttribute("viewBox", `0 0 ${width} ${height}`);
      drawing.removeAttribute("width"); drawing.removeAttribute("height");
      drawing.classList.add("printed"); drawing.setAttribute("aria-hidden", "true");
      figure.querySelector(".drawing").after(drawing);
    }
    dressAll(dark.matches);
  }
  const thaw = () => document.querySelectorAll("svg.printed").forEach((drawing) => drawing.remove());
  window.addEventListener("beforeprint", () => { if (!document.documentElement.classList.contains("paper")) freeze(); });
  window.addEventListener("afterprint", () => { if (!document.documentElement.classList.contains("paper")) thaw(); });
  window.charts = { toPaper, toScreen };
  if (location.hash === "#on-a4") {  // opened to be printed by a program
    window.addEventListener("load", () => { toPaper().then(() => { document.documentElement.dataset.paper = "ready"; }); });
  }
})();
