// Tables that sort and copy, figures that enlarge, and sections that open where a link leads.
(() => {
  const number = (text) => {
    const plain = text.trim().replace(/\u2212/g, "-").replace(/\u00d710([\u207b\u2070\u00b9\u00b2\u00b3\u2074-\u2079]+)/,
      (_, power) => "e" + [...power].map((c) => c === "\u207b" ? "-" : "\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079".indexOf(c)).join(""));
    return parseFloat(plain);
  };
  const button = (text, label, act) => {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = text;
    if (label) made.setAttribute("aria-label", label);
    made.addEventListener("click", act);
    return made;
  };
  for (const table of document.querySelectorAll("table")) {
    const body = table.tBodies[0];
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const sort = button(head.textContent, "", () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const rows = [...body.rows].map((row) => [row.cells[column].textContent.trim(), row]);
        const numeric = rows.some(([text]) => !Number.isNaN(number(text)));
        rows.sort(([a], [b]) => {
          if (!numeric) return a.localeCompare(b) * (down ? -1 : 1);
          const [x, y] = [number(a), number(b)];
          return Number.isNaN(x) ? 1 : Number.isNaN(y) ? -1 : (x - y) * (down ? -1 : 1);
        });
        body.append(...rows.map(([, row]) => row));
      });
      if (body.rows.length > 1) head.replaceChildren(sort);
    });
    const copy = button("Copy", "Copy this table", () => {
      const rows = [...table.tHead.rows, ...body.rows];
      const text = rows.map((row) => [...row.cells].map((cell) => cell.textContent.trim()).join("\t")).join("\n");
      const done = () => { copy.textContent = "Copied"; setTimeout(() => { copy.textContent = "Copy"; }, 1500); };
      if (navigator.clipboard) return navigator.clipboard.writeText(text).then(done);
      const area = document.body.appendChild(Object.assign(document.createElement("textarea"), { value: text }));
      area.select();
      document.execCommand("copy");
      area.remove();
      done();
    });
    copy.className = "tool";
    table.parentElement.after(copy);
  }
  for (const picture of document.querySelectorAll("figure .wide")) {
    picture.addEventListener("click", () => picture.classList.toggle("large"));
  }
  const hint = () => {
    for (const part of document.querySelectorAll(".wide")) {
      part.classList.toggle("scrolls", part.scrollWidth > part.clientWidth + 16);
    }
  };
  addEventListener("resize", hint);
  addEventListener("toggle", hint, true);
  hint();
  const reveal = () => {
    const wanted = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (!wanted) return;
    for (const part of wanted.querySelectorAll(":scope > details")) part.open = true;
    wanted.scrollIntoView();
  };
  addEventListener("hashchange", reveal);
  reveal();
  let closed = [];
  addEventListener("beforeprint", () => {
    closed = [...document.querySelectorAll("details:not([open]):not(.explore)")];
    for (const part of closed) part.open = true;
  });
  addEventListener("afterprint", () => { for (const part of closed) part.open = false; });
})();
