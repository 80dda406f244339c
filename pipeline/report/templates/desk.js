{ // tables, cards and the marks of map and plots: one selection, named by the page's address (#t12, #e3)
  const PAGE = 25;
  const root = document.documentElement;
  root.classList.add("desk");
  const panel = document.querySelector("#panel"), holder = panel.querySelector(".holder");
  const tables = [...document.querySelectorAll(".paged")].map((box) => {
    const body = box.querySelector("tbody"), rows = [...body.rows], output = box.querySelector("output");
    const text = new Map(rows.map((row) => [row, row.textContent.toLowerCase()]));
    const search = box.querySelector("[data-search]"), state = box.querySelector("select");
    const gallery = box.querySelector(".gallery"), pictures = box.querySelector("[data-gallery]");
    let shown = rows, first = 0;
    function show() {
      first = Math.max(0, Math.min(first, Math.floor((shown.length - 1) / PAGE) * PAGE));
      const page = shown.slice(first, first + PAGE);
      body.replaceChildren(...page);
      if (gallery) gallery.replaceChildren(...(pictures.ariaPressed === "true" ? page.map((row) => shownCard(row.dataset.link)) : []));
      output.textContent = shown.length ? `${first + 1} to ${first + page.length} of ${shown.length}` : "none";
    }
    function filter() {
      const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
      shown = rows.filter((row) => (!state.value || row.dataset.state === state.value) && words.every((word) => text.get(row).includes(word)));
      first = 0;
      show();
    }
    function sort(head) {
      const column = head.cellIndex, down = head.getAttribute("aria-sort") === "ascending", numeric = head.dataset.kind === "number";
      for (const other of box.querySelectorAll("th[aria-sort]")) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const key = (row) => {
        const cell = row.cells[column];
        return numeric ? (cell.dataset.sort === "" ? NaN : +cell.dataset.sort) : cell.textContent.trim();
      };
      const keys = new Map(rows.map((row) => [row, key(row)]));
      const order = (a, b) => {
        const x = keys.get(a), y = keys.get(b);
        if (numeric && (isNaN(x) || isNaN(y))) return isNaN(x) - isNaN(y); // unknown values come last
        const sign = numeric ? x - y : x.localeCompare(y, "en", { numeric: true });
        return down ? -sign : sign;
      };
      rows.sort(order);
      filter();
    }
    box.addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (button && button.classList.contains("sort")) sort(button.closest("th"));
      else if (button === pictures) { button.ariaPressed = String(button.ariaPressed !== "true"); show(); }
      else if (button) { first += PAGE * +button.dataset.page; show(); }
      else { const row = event.target.closest("tbody tr"); if (row && !event.target.closest("a")) location.hash = row.dataset.link; }
    });
    box.querySelector(".tools").hidden = false;
    search.addEventListener("input", filter);
    state.addEventListener("change", filter);
    show();
    return {
      box, filter, links: () => shown.map((row) => row.dataset.link),
      name: (link) => rows.find((row) => row.dataset.link === link)?.cells[0].textContent ?? "",
      has: (link) => rows.some((row) => row.dataset.link === link),
      find(link) {
        let at = shown.findIndex((row) => row.dataset.link === link);
        if (at < 0) { search.value = state.value = ""; filter(); at = shown.findIndex((row) => row.dataset.link === link); }
        first = Math.floor(at / PAGE) * PAGE;
        show();
        return shown[at];
      },
      mark(link) { for (const row of rows) row.classList.toggle("chosen", row.dataset.link === link); },
      printAll(all) { if (all) body.replaceChildren(...shown); else show(); },
    };
  });
  const cards = new Map([...document.querySelectorAll("#cards article")].map((card) => [card.id, card]));
  for (const card of cards.values()) card.removeAttribute("id"); // the address selects a card, it does not scroll to it
  const more = JSON.parse(document.querySelector("#more-cards").textContent); // as text: a thousand cards cost no time
  function cardOf(link) {
    if (!cards.has(link) && Object.hasOwn(more, link)) {
      const holder = document.createElement("template");
      holder.innerHTML = more[link];
      const card = holder.content.querySelector("article");
      card.removeAttribute("id");
      cards.set(link, card);
    }
    return cards.get(link);
  }
  function shownCard(link) { // a copy, with chip and strip one over the other
    const card = cardOf(link).cloneNode(true), overlay = card.querySelector(".overlay .shot");
    if (overlay) overlay.append(...[...card.querySelectorAll(".shot img")].slice(0, 2).map((image) => image.cloneNode()));
    return card;
  }
  let chosen = "";
  function choose() {
    const link = location.hash.slice(1), card = cardOf(link);
    for (const mark of document.querySelectorAll(".spot.chosen, .dot.chosen")) mark.classList.remove("chosen");
    if (!card) { if (chosen && !link) close(); chosen = card ? link : ""; for (const table of tables) table.mark(""); return; }
    chosen = link;
    holder.replaceChildren(shownCard(link));
    panel.hidden = false;
    for (const mark of document.querySelectorAll(`.spot[href="#${link}"], .dot[data-link="${link}"]`)) {
      mark.classList.add("chosen");
      mark.parentNode.append(mark); // above the others
    }
    for (const to of ["map", "plot"]) panel.querySelector(`[data-to=${to}]`).disabled = !markOf(to);
    for (const table of tables) table.mark(link);
  }
  const markOf = (to) => document.querySelector(to === "map" ? ".spot.chosen" : ".dot.chosen");
  function close() {
    panel.hidden = true;
    chosen = "";
    history.replaceState(null, "", location.pathname + location.search);
    for (const mark of document.querySelectorAll(".chosen")) mark.classList.remove("chosen");
  }
  function step(by) {
    const table = tables.find((one) => one.has(chosen)), links = table.links(), at = links.indexOf(chosen);
    const next = links[Math.max(0, Math.min(links.length - 1, at + by))];
    if (next) location.hash = next;
  }
  panel.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    if (button.dataset.step) step(+button.dataset.step);
    else if (button.dataset.to === "map") {
      const mark = markOf("map"), box = mark.closest(".zoom"), place = getComputedStyle(mark);
      box.zoomTo(+place.getPropertyValue("--x"), +place.getPropertyValue("--y"), 140);
      box.scrollIntoView({ block: "start" });
    } else if (button.dataset.to === "plot") markOf("plot").closest("figure").scrollIntoView({ block: "start" });
    else if (button.dataset.to === "row") {
      const row = tables.find((one) => one.has(chosen)).find(chosen);
      row.scrollIntoView({ block: "nearest" });
      row.querySelector("a").focus({ preventScroll: true });
    } else close();
  });
  addEventListener("keydown", (event) => { if (event.key === "Escape" && !panel.hidden) close(); });
  addEventListener("hashchange", choose);
  const linkOf = (mark) => mark.dataset.link || mark.getAttribute("href").slice(1);
  document.addEventListener("click", (event) => {
    const mark = event.target.closest(".spot, .dot");
    if (!mark) return;
    event.preventDefault(); // the map must not scroll away
    location.hash = linkOf(mark);
  });
  function wordsOf(link) {
    const spot = document.querySelector(`.spot[href="#${link}"]`);
    return spot ? spot.getAttribute("aria-label") : `exposure ${tables.map((one) => one.name(link)).join("")}`;
  }
  const tip = document.querySelector("#tip");
  document.addEventListener("pointerover", (event) => {
    const mark = event.target.closest?.(".spot, .dot");
    tip.hidden = !mark;
    if (!mark) return;
    tip.textContent = wordsOf(linkOf(mark));
    const edge = mark.getBoundingClientRect();
    tip.style.left = `${Math.max(4, Math.min(edge.left, innerWidth - tip.offsetWidth - 8))}px`;
    tip.style.top = `${edge.bottom + 8 + tip.offsetHeight > innerHeight ? edge.top - tip.offsetHeight - 8 : edge.bottom + 8}px`;
  });
  for (const box of document.querySelectorAll(".zoom.map")) {
    const ground = box.querySelector(".bar.ground"), residual = box.querySelector(".bar.residual"), checked = box.querySelector(".bar.checked");
    const nice = (most) => { const power = 10 ** Math.floor(Math.log10(most)); return power * [5, 2, 1].find((step) => step * power <= most); };
    const length = (metres) => metres >= 1000 ? `${metres / 1000} km` : `${+metres.toPrecision(3)} m`;
    box.addEventListener("zoomed", (event) => {
      const width = event.detail.w;
      for (const [bar, metres, text] of [[ground, +box.dataset.metres, ""], [residual, +box.dataset.residual, "residual "], [checked, +box.dataset.check, "error of check points "]]) {
        if (!bar) continue;
        const most = nice(0.25 * width * metres);
        bar.style.width = `${most / (metres * width) * 100}%`;
        bar.textContent = text + length(most);
      }
    });
    box.addEventListener("click", (event) => {
      const button = event.target.closest("[data-layer]");
      if (!button) return;
      button.setAttribute("aria-pressed", String(!box.classList.toggle(`no-${button.dataset.layer}`)));
    });
    box.zoomTo(500, 0, 1000);
  }
  addEventListener("beforeprint", () => { for (const part of document.querySelectorAll("details")) part.open = true; for (const table of tables) table.printAll(true); for (const box of document.querySelectorAll(".zoom")) box.zoomTo(0, 0, 1e9); });
  addEventListener("afterprint", () => { for (const table of tables) table.printAll(false); });
  choose();
}
