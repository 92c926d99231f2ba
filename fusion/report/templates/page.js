"use strict";
// A table that is wider than its place can be scrolled with the keyboard; the page prints with charts in the size of the paper.
function reachTables() {
  for (const part of document.querySelectorAll(".scroll")) {
    if (part.scrollWidth > part.clientWidth) part.tabIndex = 0; else part.removeAttribute("tabindex");
  }
}
window.addEventListener("load", reachTables);
window.addEventListener("resize", reachTables);
document.querySelectorAll("details").forEach((part) => part.addEventListener("toggle", reachTables));
for (const link of document.querySelectorAll("nav.contents a")) {  // a link of the contents opens what its target is folded into
  link.addEventListener("click", () => {
    const target = document.getElementById(link.hash.slice(1));
    for (let part = target && target.closest("details"); part; part = part.parentElement.closest("details")) part.open = true;
  });
}
document.querySelectorAll("button.print").forEach((button) => button.addEventListener("click", async () => {
  if (window.charts) await window.charts.toPaper();
  window.print();
  if (window.charts) window.charts.toScreen();
}));
