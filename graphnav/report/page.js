// Unpacks plotly, draws each figure when it comes into sight and all of them before printing, keeps the time axes of
// all figures together, and draws again in the colours of a dark or light page.
(() => {
  // RFC 1951 in zlib's envelope, all at once: browsers unpack streams only later, when a page may be printed already
  const inflate = (data, size) => {
    const out = new Uint8Array(size);
    let at = 2, to = 0, held = 0, have = 0, last;
    const need = n => { for (; have < n; have += 8) held |= data[at++] << have; };
    const drop = n => { held >>>= n; have -= n; };
    const bits = n => { need(n); const value = held & ((1 << n) - 1); drop(n); return value; };
    const codes = lengths => {  // by the bits that come next: symbol and length of its code
      const table = new Uint16Array(1 << Math.max(...lengths));
      for (let n = 1, code = 0; 1 << n <= table.length; n++, code <<= 1) lengths.forEach((length, symbol) => {
        if (length !== n) return;
        let k = 0;
        for (let bit = 0; bit < n; bit++) k |= (code >> bit & 1) << n - 1 - bit;
        for (; k < table.length; k += 1 << n) table[k] = symbol << 4 | n;
        code++;
      });
      return table;
    };
    const next = table => { need(15); const found = table[held & table.length - 1]; drop(found & 15); return found >> 4; };
    const same = (count, length) => Array(count).fill(length);
    const steps = (first, few, each) => {  // where the lengths, or distances, of each symbol begin; their bits
      const begins = [first], more = [];
      for (let k = 0; k < 30; k++) begins.push(begins[k] + (1 << (more[k] = k < few ? 0 : (k - few) / each + 1 | 0)));
      return [begins, more];
    };
    const [lengthOf, lengthBits] = steps(3, 8, 4), [distanceOf, distanceBits] = steps(1, 4, 2);
    lengthOf[28] = 258;
    lengthBits[28] = 0;
    do {
      last = bits(1);
      const kind = bits(2);
      if (kind === 0) {
        at -= have >> 3;
        held = have = 0;
        const count = data[at] | data[at + 1] << 8;
        out.set(data.subarray(at += 4, at += count), to);
        to += count;
        continue;
      }
      let literals = [...same(144, 8), ...same(112, 9), ...same(24, 7), ...same(8, 8)], distances = same(30, 5);
      if (kind === 2) {
        const many = bits(5) + 257, far = bits(5) + 1, count = bits(4) + 4, own = same(19, 0), all = [];
        [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15].slice(0, count).forEach(k => own[k] = bits(3));
        const table = codes(own);
        while (all.length < many + far) {
          const one = next(table);
          if (one < 16) all.push(one);
          else if (one === 16) all.push(...same(bits(2) + 3, all.at(-1)));
          else all.push(...same(one === 17 ? bits(3) + 3 : bits(7) + 11, 0));
        }
        literals = all.slice(0, many);
        distances = all.slice(many);
      }
      const literal = codes(literals), distance = codes(distances);
      for (let one; (one = next(literal)) !== 256;) {
        if (one < 256) {
          out[to++] = one;
          continue;
        }
        const end = to + lengthOf[one -= 257] + bits(lengthBits[one]), k = next(distance);
        for (let from = to - distanceOf[k] - bits(distanceBits[k]); to < end;) out[to++] = out[from++];
      }
    } while (!last);
    return out;
  };
  const unpacked = element => {
    const packed = Uint8Array.from(atob(element.textContent), c => c.charCodeAt(0));
    return new TextDecoder().decode(inflate(packed, Number(element.dataset.size)));
  };
  const library = document.createElement("script");
  library.textContent = unpacked(document.getElementById("plotly-library"));
  document.head.append(library);
  const places = [...document.querySelectorAll(".plot")];
  const texts = places.map(place => unpacked(place.nextElementSibling));
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
    const moves = others(place).map(one => Plotly.relayout(one, {"xaxis.range": range.map(onClock)}));
    Promise.all(moves).then(() => point(pointed));
  };

  let pointed = null;  // time under the mouse, on the clock
  const point = x => {
    pointed = x;
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
  // in the frame to come, when the styles are those of the new colours
  dark.addEventListener("change", () => requestAnimationFrame(() => places.filter(place => place.data).forEach(draw)));

  // A4 between its margins is 703 pixels wide; three figures stand beside each other there, or four without more
  addEventListener("beforeprint", () => places.forEach(place => {
    if (place.closest("details:not([open])")) return;
    draw(place);
    place.dataset.height ||= place.style.height;
    const whole = place.closest(".large, figure:only-child"), height = parseFloat(place.dataset.height);
    const {tickvals: named, scaleanchor: map} = place.layout.yaxis;  // a line for each name; the sky
    const most = whole ? (named ? 600 : 220) : map ? 200 : 160;
    const beside = place.closest(".figures").children.length === 4 ? 4 : 3;
    const size = {width: whole ? 700 : 712 / beside - 12, height: Math.min(most, 0.65 * height)};
    place.style.height = `${size.height}px`;
    Plotly.relayout(place, {autosize: false, "font.size": 8, "margin.t": 15, "margin.b": 30, ...size});
  }));
  addEventListener("afterprint", () => places.filter(place => place.dataset.height).forEach(place => {
    place.style.height = place.dataset.height;
    draw(place);
  }));
  document.documentElement.dataset.ready = "";
})();
