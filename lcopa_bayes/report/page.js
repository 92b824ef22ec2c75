// Tables that sort, filter and copy, figures that enlarge, and sections that open where a link leads.
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
  const LONG = 12; // rows from which a table has a filter
  const filter = (table, body) => {
    const field = Object.assign(document.createElement("input"), { type: "search", placeholder: "Filter rows" });
    const count = document.createElement("span");
    field.setAttribute("aria-label", "Filter the rows of this table: those with all of the words stay");
    count.setAttribute("role", "status");
    field.addEventListener("input", () => {
      const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
      for (const row of body.rows) {
        const text = [...row.cells].map((cell) => cell.textContent).join(" ").toLowerCase();
        row.hidden = !words.every((word) => text.includes(word));
      }
      const shown = [...body.rows].filter((row) => !row.hidden).length;
      count.textContent = words.length ? `${shown} of ${body.rows.length} rows` : "";
    });
    const place = document.createElement("div");
    place.className = "filter";
    place.append(field, count);
    table.parentElement.before(place);
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
      const rows = [...table.tHead.rows, ...body.rows].filter((row) => !row.hidden);
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
    if (body.rows.length >= LONG) filter(table, body);
  }
  // On a narrow screen panels side by side stand one below the other, and a legend by itself, as views of the
  // one drawing, and a wide panel is squeezed but for its text and markers: shrunk to the screen as a whole its
  // text would be too small to read.
  const narrow = matchMedia("screen and (max-width: 40rem)");
  const around = (boxes) => {
    const [x, y] = ["x", "y"].map((at) => Math.min(...boxes.map((box) => box[at])));
    const width = Math.max(...boxes.map((box) => box.x + box.width)) - x;
    return { x, y, width, height: Math.max(...boxes.map((box) => box.y + box.height)) - y };
  };
  const apart = (boxes, at, size) => {
    const groups = [];
    let end = -Infinity;
    for (const box of [...boxes].sort((a, b) => a[at] - b[at])) {
      if (box[at] > end) groups.push([]);
      groups[groups.length - 1].push(box);
      end = Math.max(end, box[at] + box[size]);
    }
    return groups;
  };
  const outline = (axes) => around([...axes.children].filter((part, k) => !k || /axis_|text_|legend_/.test(part.id))
    .map((part) => part.getBBox()));
  const labelled = (axes) => [...axes.querySelectorAll("g[id*='axis_']")].map((axis) => !!axis.querySelector("text"));
  const moved = new Map(); // and how it stood before
  const move = (part, how, hidden) => {
    moved.set(part, part.getAttribute("transform"));
    part.setAttribute("transform", `${how} ${part.getAttribute("transform") || ""}`);
    if (hidden) part.setAttribute("visibility", "hidden");
  };
  const squeeze = (axes, view, most) => {
    const panel = axes.firstElementChild.getBBox(), end = panel.x + panel.width;
    const k = 1 - (view.width - most) / panel.width;
    let taken = -Infinity; // by labels of ticks, which keep apart
    for (const part of axes.querySelectorAll("use, g[id*='text_'], g[id*='legend_']")) {
      const box = part.getBBox(), right = box.x + box.width, middle = box.x + box.width / 2, mark = part.matches("use");
      if (part.parentElement.closest("g[id*='legend_']") || (mark && box.width > 12)) continue; // an area
      const at = mark ? middle : box.x < panel.x + 2 ? panel.x : right > end - 2 ? end : middle;
      const free = (k - 1) * Math.max(0, Math.min(at, end) - panel.x);
      const by = mark ? free : Math.max(view.x - box.x, Math.min(free, view.x + most - right));
      const label = !mark && part.closest("g[id*='xtick_']"), hidden = label && box.x + by < taken + 3;
      if (label && !hidden) taken = right + by;
      move(part, `translate(${panel.x + (by - panel.x) / k}) scale(${1 / k} 1)`, hidden);
    }
    move(axes, `translate(${panel.x * (1 - k)}) scale(${k} 1)`);
  };
  const lines = (legend, most) => {
    const out = [];
    let entry = [];
    for (const part of legend.children) {
      entry.push(part.getBBox());
      if (!/text_/.test(part.id)) continue;
      const longer = around([...out.slice(-1), ...entry]);
      out.splice(longer.width > most ? out.length : -1, 1, longer.width > most ? around(entry) : longer);
      entry = [];
    }
    return out;
  };
  const views = (drawn, whole, most) => {
    const boxes = [...drawn.children].slice(1).map((part) => /axes_/.test(part.id)
      ? { ...outline(part), panel: labelled(part), part } : { ...around([part.getBBox()]), part });
    return apart(boxes, "y", "height").flatMap((row) => {
      if (row.length === 1 && /legend_/.test(row[0].part.id)) return lines(row[0].part, most);
      const columns = apart(row, "x", "width");
      const panels = row.map((box) => box.panel || []);  // those that share labels with others stay beside them
      const alone = panels.every(([across, up]) => across && up === panels[0][1]);
      if (alone && columns.length > 1 && columns.length < 4) return columns.map(around);
      const full = row.some((box) => box.panel) && { x: whole.x + 3, width: whole.width - 6 };
      const [one, ...more] = row.filter((box) => box.panel);
      return [{ ...around(row), ...full, axes: full.width > most && !more.length && one.part }];
    });
  };
  const stack = () => {
    for (const [part, transform] of moved) {
      if (transform === null) part.removeAttribute("transform"); else part.setAttribute("transform", transform);
      part.removeAttribute("visibility");
    }
    moved.clear();
    for (const svg of document.querySelectorAll("figure .wide > svg:first-child")) {
      const drawn = svg.querySelector("g[id$='figure_1']"), place = svg.parentElement;
      while (svg.nextElementSibling) svg.nextElementSibling.remove();
      svg.setAttribute("viewBox", svg.dataset.whole = svg.dataset.whole || svg.getAttribute("viewBox"));
      svg.removeAttribute("style");
      if (!narrow.matches || place.classList.contains("large") || !svg.getClientRects().length) continue;
      const most = place.clientWidth / 1.2; // so that letters of 7.5 points have 9 pixels
      views(drawn, svg.viewBox.baseVal, most).forEach((box, k) => {
        if (box.axes) squeeze(box.axes, box, most), box.width = most;
        const part = k ? place.appendChild(svg.cloneNode()) : svg;
        if (k) part.appendChild(document.createElementNS(svg.namespaceURI, "use")).setAttribute("href", `#${drawn.id}`);
        const [width, height] = [box.width + 6, box.height + 6];
        part.setAttribute("viewBox", `${box.x - 3} ${box.y - 3} ${width} ${height}`);
        part.setAttribute("style", `aspect-ratio: ${width} / ${height}; max-width: ${1.4 * width}px`);
      });
    }
  };
  for (const picture of document.querySelectorAll("figure .wide")) {
    picture.addEventListener("click", () => { picture.classList.toggle("large"); stack(); });
  }
  const hint = () => {
    stack();
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
