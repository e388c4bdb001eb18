// A number in data-v decides, else the text; what has neither (a dash) stays last either way.
document.querySelectorAll("table.sortable th").forEach(head => head.addEventListener("click", () => {
  const table = head.closest("table"), body = table.tBodies[0], column = head.cellIndex;
  const down = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
  table.querySelectorAll("th").forEach(other => other.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", down === 1 ? "ascending" : "descending");
  const value = row => row.cells[column].dataset.v, text = row => row.cells[column].textContent;
  Array.from(body.rows).sort((a, b) => {
    const x = value(a), y = value(b);
    if (x === undefined && y === undefined) return down * text(a).localeCompare(text(b));
    if (x === "" || y === "") return (x === "") - (y === "");
    return down * (Number(x) - Number(y));
  }).forEach(row => body.append(row));
}));
