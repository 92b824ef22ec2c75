// Values under the cursor, and a zoom that all panels of a record share.
(() => {
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const drawn = (given, panel, width, key, all) => {
    const marks = panel.series.map((one) => ({
      label: one.label,
      scale: "y",
      stroke: one.kind === "band" ? "transparent" : colour(one.colour),
      width: one.kind === "points" ? 0 : 1.3,
      points: { show: one.kind === "points", size: 4, fill: colour(one.colour) },
      paths: one.kind === "points" ? () => null : one.kind === "steps" ? uPlot.paths.stepped({ align: 1 }) : undefined,
      value: (_, v) => v == null ? "" : String(+v.toPrecision(4)),
    }));
    const band = panel.series.findIndex((one) => one.kind === "band");
    const axis = { stroke: colour("--ink"), grid: { stroke: colour("--line"), width: 0.5 } };
    return new uPlot({
      width,
      height: panel.series.length > 1 ? 240 : 130,
      title: panel.title,
      scales: { x: { time: false } },
      cursor: { sync: { key, scales: ["x", null] } },
      bands: band < 0 ? [] : [{ series: [band + 2, band + 1], fill: colour("--band") + "44" }],
      axes: [{ ...axis, size: 34 }, { ...axis, size: 76, values: (_, ticks) => ticks.map((v) => String(+v.toPrecision(6))) }],
      series: [{ label: given.time, value: (_, v) => v == null ? "" : String(+v.toPrecision(6)) }, ...marks],
      hooks: {
        setScale: [(own, scale) => {
          if (scale !== "x") return;
          const { min, max } = own.scales.x;
          for (const other of all) {
            if (other !== own && (other.scales.x.min !== min || other.scales.x.max !== max)) {
              other.setScale("x", { min, max });
            }
          }
        }],
      },
    }, [panel.time, ...panel.series.map((one) => one.values)], document.createElement("div"));
  };
  document.querySelectorAll("details.explore").forEach((part, number) => {
    const given = JSON.parse(part.querySelector("script").textContent);
    const all = [];
    part.addEventListener("toggle", () => {
      if (!part.open || all.length) return;
      const width = part.clientWidth;
      for (const panel of given.panels) {
        const own = drawn(given, panel, width, "explore" + number, all);
        part.append(own.root);
        all.push(own);
      }
      addEventListener("resize", () => all.forEach((one) => one.setSize({ width: part.clientWidth, height: one.height })));
    });
  });
})();
