"use strict";
// A table of many campaigns: a click on a heading sorts by it, a second one turns the order; a word leaves the rows that hold it.
const table = document.querySelector("#campaigns table");
const value = (row, at) => {
  const text = row.cells[at].innerText.trim();
  const figure = parseFloat(text.replace(/^> /, "").replace("−", "-").replace(/[^\d.eE+-].*$/, ""));
  return text === "–" ? null : Number.isNaN(figure) || /^\d{4}-\d\d/.test(text) ? text : figure;
};
const compare = (one, other) =>
  one === null || other === null ? (one === null) - (other === null)
    : typeof one === "number" && typeof other === "number" ? one - other : String(one).localeCompare(String(other));
table.querySelectorAll("thead button").forEach((button, at) => button.addEventListener("click", () => {
  const heading = button.closest("th"), turned = heading.getAttribute("aria-sort") === "ascending";
  table.querySelectorAll("th[aria-sort]").forEach((one) => one.removeAttribute("aria-sort"));
  heading.setAttribute("aria-sort", turned ? "descending" : "ascending");
  const rows = [...table.tBodies[0].rows].map((row) => [value(row, at), row]);
  // What is not there stays at the end in both orders.
  rows.sort(([one], [other]) => one === null || other === null || !turned ? compare(one, other) : compare(other, one));
  table.tBodies[0].append(...rows.map(([, row]) => row));
}));
const field = document.querySelector("#filter");
field.addEventListener("input", () => {
  for (const row of table.tBodies[0].rows) row.hidden = !row.innerText.toLowerCase().includes(field.value.toLowerCase());
});
