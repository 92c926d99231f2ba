// Names for controls that the library of widgets leaves unnamed: handles of sliders, and the buttons of number fields.
const named = (view) => {
  const root = view.shadow_el ?? view.el?.shadowRoot;
  const title = view.model?.title;
  if (root && title) {
    root.querySelectorAll(".noUi-handle:not([aria-label])").forEach((handle) => handle.setAttribute("aria-label", title));
    root.querySelectorAll(".bk-spin-btn:not([aria-label])").forEach((button) => {
      button.setAttribute("aria-label", `${title}, ${button.classList.contains("bk-spin-btn-up") ? "more" : "less"}`);
    });
  }
  (view.child_views ?? []).forEach(named);
};
setInterval(() => window.Bokeh?.index?.roots?.forEach(named), 500);
