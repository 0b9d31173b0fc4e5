// Unpacks plotly, draws each figure when it comes into sight and all of them before printing, keeps the time axes of
// all figures together, and draws again in the colours of a dark or light page.
(async () => {
  const unpacked = element => {
    const packed = Uint8Array.from(atob(element.textContent), c => c.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"))).text();
  };
  const library = document.createElement("script");
  library.textContent = await unpacked(document.getElementById("plotly-library"));
  document.head.append(library);
  const places = [...document.querySelectorAll(".plot")];
  const texts = await Promise.all(places.map(place => unpacked(place.nextElementSibling)));
  const touch = matchMedia("(pointer: coarse)").matches;
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const config = {responsive: true, displaylogo: false, displayModeBar: touch ? true : "hover",
    modeBarButtons: [["zoom2d", "pan2d", "autoScale2d", "resetScale2d"]]};
  const clock = document.getElementById("clock");
  let shared = null;  // range of the time axis of all figures, s from the start, null as they come
  const timed = place => place.dataset.time !== undefined;

  const draw = place => {
    const style = getComputedStyle(document.documentElement);
    const figure = JSON.parse(texts[places.indexOf(place)].replace(/var\((--[\w-]+)\)/g, (_, name) => style.getPropertyValue(name).trim()));
    figure.layout.dragmode = touch ? false : "zoom";
    if (timed(place)) time(figure);
    const first = !place.data;
    const drawn = Plotly.react(place, figure.data, figure.layout, config);
    if (first && timed(place)) {
      place.on("plotly_relayout", change => together(place, change));
      place.on("plotly_hover", event => point(event.xvals?.[0]));
      place.on("plotly_unhover", () => point(null));
    }
    // zoomed only now: the house leads back to all of it
    if (timed(place) && shared) Plotly.relayout(place, {"xaxis.range": shared.map(onClock)});
    return drawn;
  };

  // a figure over s from the start as one over the clock that was chosen, a date where it is one of the day
  const date = () => clock?.value && clock.selectedOptions[0].dataset.date !== undefined;
  const zero = () => Number(clock?.value || 0);
  const onClock = s => date() ? 1000 * (zero() + s) : zero() + s;
  const fromStart = x => (date() ? x / 1000 : x) - zero();
  const time = ({data, layout}) => {
    layout.xaxis.range = layout.xaxis.range.map(onClock);
    if (!clock?.value) return;
    for (const trace of data) {
      const packed = trace.x.bdata && Uint8Array.from(atob(trace.x.bdata), c => c.charCodeAt(0));
      trace.x = Array.from(packed ? new Float32Array(packed.buffer) : trace.x, s => Number.isFinite(s) ? onClock(s) : null);
    }
    for (const one of layout.shapes) Object.assign(one, {x0: onClock(one.x0), x1: onClock(one.x1)});
    for (const one of layout.annotations) if (one.xref === "x") one.x = onClock(one.x);
    Object.assign(layout.xaxis, date() ? {type: "date", hoverformat: "%H:%M:%S.%2f"} : {tickformat: ".10~f"});
    layout.xaxis.title.text = clock.selectedOptions[0].text;
  };
  clock?.addEventListener("change", () => places.filter(place => place.data && timed(place)).forEach(place => {
    Plotly.purge(place);
    draw(place);
  }));

  // what is in a figure, beside its tints; a click hides it
  const legend = (place, traces) => {
    const box = Object.assign(document.createElement("div"), {className: "legend"});
    for (const trace of traces.filter(one => one.showlegend)) {
      const tint = trace.x[0] === null;
      const entry = document.createElement(tint ? "span" : "button"), mark = document.createElement("i");
      mark.className = trace.fill || tint ? "band" : trace.mode === "lines" ? "line" : "dots";
      mark.style.background = /var\(--[\w-]+\)/.exec(trace.fillcolor || (trace.line || trace.marker).color)[0];
      entry.append(mark, trace.name);
      if (!tint) entry.addEventListener("click", () => {
        const rows = [...place.data.keys()].filter(k => place.data[k].legendgroup === trace.name);
        Plotly.restyle(place, {visible: !entry.classList.toggle("off")}, rows);
      });
      box.append(entry);
    }
    place.before(box);
  };
  places.forEach((place, k) => legend(place, JSON.parse(texts[k]).data));

  const others = place => places.filter(one => one !== place && one.data && timed(one));
  const together = (place, change) => {
    const axis = place._fullLayout.xaxis, range = axis.range.map(x => fromStart(axis.r2l(x)));
    const moved = Object.keys(change).some(key => key.startsWith("xaxis."));
    if (!moved || (shared && Math.max(...range.map((x, k) => Math.abs(x - shared[k]))) < 1e-3)) return;
    shared = range;
    for (const one of others(place)) Plotly.relayout(one, {"xaxis.range": range.map(onClock)});
  };

  const point = x => {
    for (const place of places.filter(one => one.data && timed(one))) {
      let cursor = place.querySelector(".cursor");
      if (!cursor) place.append(cursor = Object.assign(document.createElement("div"), {className: "cursor"}));
      const axis = place._fullLayout.xaxis, at = x == null ? -1 : axis.l2p(x);
      cursor.hidden = at < 0 || at > axis._length;
      cursor.style.left = `${axis._offset + at}px`;
    }
  };

  const seen = new IntersectionObserver(all => all.filter(one => one.isIntersecting).forEach(({target}) => {
    seen.unobserve(target);
    if (!target.data) draw(target);
  }), {rootMargin: "200px"});
  places.forEach(place => seen.observe(place));
  dark.addEventListener("change", () => places.filter(place => place.data).forEach(draw));

  // A4 between its margins is 703 pixels wide; three figures stand beside each other there
  addEventListener("beforeprint", () => places.forEach(place => {
    if (place.closest("details:not([open])")) return;
    draw(place);
    place.dataset.height ||= place.style.height;
    const whole = place.closest(".large, figure:only-child"), height = parseFloat(place.dataset.height);
    const size = {width: whole ? 700 : 226, height: Math.min(whole ? 260 : 200, 0.65 * height)};
    place.style.height = `${size.height}px`;
    Plotly.relayout(place, {autosize: false, "font.size": 8, "margin.t": 15, "margin.b": 30, ...size});
  }));
  addEventListener("afterprint", () => places.filter(place => place.dataset.height).forEach(place => {
    place.style.height = place.dataset.height;
    draw(place);
  }));
  document.documentElement.dataset.ready = "";
})();
