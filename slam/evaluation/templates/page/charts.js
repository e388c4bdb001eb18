// Charts with a reading under the pointer; a click on one over time moves the player there.
"use strict";
(S => {
  const element = S.element, drawn = [];

  // Values are sorted by x; several points may share one.
  function options(chart, width) {
    const axis = {stroke: S.color("soft"), grid: {stroke: S.color("line"), width: 1}, ticks: {stroke: S.color("line")}};
    const series = chart.series.map(one => {
      const stroke = S.color(one.color);
      return {
        label: one.name, stroke, width: chart.lines ? 1.4 : 0, spanGaps: false,
        points: chart.lines ? {show: false} : {show: true, size: 4, fill: stroke, stroke, width: 0},
        value: (_, value) => value === null || value === undefined ? "–" : Number(value.toPrecision(4)).toString(),
        ...(chart.lines ? {} : {paths: () => null}),
      };
    });
    const least = (_, low, high) => [Math.min(0, low ?? 0), chart.most ?? (high > 0 ? 1.05 * high : 1)];
    return {
      width, height: 190, legend: {live: true, markers: {width: 0, fill: (plot, number) => plot.series[number].stroke()}}, cursor: {points: {size: 7}},
      scales: {x: {time: false}, y: {range: least}},
      axes: [{...axis, label: chart.across, labelSize: 18, labelFont: "12px system-ui"}, {...axis, size: 54}],
      series: [{label: chart.across, value: (_, value) => value === null || value === undefined ? "–" : value.toFixed(2)}, ...series],
      bands: chart.band ? [{series: [1, 2], fill: `${S.color("blue")}`.replace("rgb(", "rgba(").replace(")", ", 0.22)")}] : [],
      hooks: chart.across === "time, s" ? {ready: [plot => {
        plot.over.addEventListener("click", () => S.player && S.player.seek(plot.posToVal(plot.cursor.left, "x")));
      }]} : {},
    };
  }

  function draw() {
    const section = document.getElementById("charts");
    drawn.splice(0).forEach(plot => plot.destroy());
    const grid = element("div", {class: "charts"});
    section.replaceChildren(element("h2", {textContent: "Over time"}), grid);
    const columns = grid.clientWidth >= 900 ? 2 : 1;
    const width = Math.floor((grid.clientWidth - 16 * (columns - 1)) / columns);
    for (const chart of S.data.charts) {
      const box = element("figure", {}, element("figcaption", {textContent: chart.title},
        chart.above ? element("span", {class: "soft", textContent: ` ${S.count(chart.above)} higher`}) : null));
      grid.append(box);
      const values = chart.series.map(one => Array.from(one.values, value => Number.isFinite(value) ? value : null));
      drawn.push(new uPlot(options(chart, width), [Array.from(chart.x), ...values], box));
    }
  }

  S.ready(data => {
    if (!data.charts || !data.charts.length) return;
    document.getElementById("charts").hidden = false;
    let width = 0, waiting = null;
    // They are drawn when they come into sight or are printed, and anew where the page has become wider or narrower.
    const observer = new IntersectionObserver(entries => entries.some(entry => entry.isIntersecting) && show(), {rootMargin: "300px"});
    function show() {
      observer.disconnect();
      removeEventListener("beforeprint", show);
      draw();
      width = innerWidth;
      S.on("theme", draw);
      addEventListener("resize", () => {
        clearTimeout(waiting);
        waiting = setTimeout(() => {
          if (innerWidth !== width) draw();
          width = innerWidth;
        }, 150);
      });
    }
    observer.observe(document.getElementById("charts"));
    addEventListener("beforeprint", show);
  }, 70);
})(Scanweave);
