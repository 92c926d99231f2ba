"use strict";
// A link of the contents opens what its target is folded into.
for (const link of document.querySelectorAll("nav.contents a")) {
  link.addEventListener("click", () => {
    const target = document.getElementById(link.hash.slice(1));
    for (let part = target && target.closest("details"); part; part = part.parentElement.closest("details")) part.open = true;
  });
}
