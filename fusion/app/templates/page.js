// What the library of widgets and charts leaves open, looked after while the page stands: names of controls, and charts on a dark page.
const named = (view) => {
  const root = view.shadow_el ?? view.el?.shadowRoot;
  const title = view.model?.title;
  // A search field is one without being told so.
  root?.querySelectorAll("input.choices__input[role]").forEach((input) => input.removeAttribute("role"));
  root?.querySelectorAll("input[type=range]:not([aria-label])").forEach((input) => input.setAttribute("aria-label", title || "Cycle"));
  root?.querySelectorAll("button[class]:not([aria-label])").forEach((button) => {
    if (!button.innerText.trim()) button.setAttribute("aria-label", button.classList[0]);
  });
  if (root && title) {
    root.querySelectorAll(".noUi-handle:not([aria-label])").forEach((handle) => handle.setAttribute("aria-label", title));
    root.querySelectorAll(".bk-spin-btn:not([aria-label])").forEach((button) => {
      button.setAttribute("aria-label", `${title}, ${button.classList.contains("bk-spin-btn-up") ? "more" : "less"}`);
    });
  }
};

// Lines and points turn their lightness and keep their hue; a map keeps the colours of its scale, and only what stands around it turns.
const dark = window.matchMedia("(prefers-color-scheme: dark)");
const TURNED = { "#ffffff": "#1b2226", "#1f2a30": "#e7ecee", "#566269": "#a9b5bb" };
const BACK = Object.fromEntries(Object.entries(TURNED).map(([light, night]) => [night, light]));
const turned = (view) => {
  const plot = view.model;
  if (!view.canvas_view || view.turned === dark.matches) return;
  view.turned = dark.matches;
  if (!plot.renderers.some((one) => one.glyph?.type === "Image")) {
    view.el.style.filter = dark.matches ? "invert(0.9) hue-rotate(180deg)" : "";
    return;
  }
  const colours = dark.matches ? TURNED : BACK;
  view.el.style.backgroundColor = dark.matches ? TURNED["#ffffff"] : "";
  [plot, ...plot.left, ...plot.right, ...plot.above, ...plot.below].forEach((part) => {
    for (const [name, value] of Object.entries(part.attributes)) {
      const other = /_color$/.test(name) && colours[String(value?.value ?? value).toLowerCase()];
      if (other) part[name] = other;
    }
  });
};

const visit = (view) => {
  named(view);
  turned(view);
  (view.child_views ?? []).forEach(visit);
};
setInterval(() => window.Bokeh?.index?.roots?.forEach(visit), 300);
