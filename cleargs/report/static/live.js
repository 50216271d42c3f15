// Shows the progress of a run. When the run is done, it opens the report.
"use strict";
{
  const EVERY_MS = 2000;
  const one = (id) => document.getElementById(id);

  const duration = (seconds) => {
    if (seconds < 90) return `${Math.round(seconds)} s`;
    const minutes = Math.round(seconds / 60);
    return minutes < 90 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
  };

  const row = ({ name, state, seconds }) => {
    const item = document.createElement("li");
    item.dataset.state = state;
    for (const text of [name, seconds === null ? state : `${state} in ${duration(seconds)}`]) {
      item.append(Object.assign(document.createElement("span"), { textContent: text }));
    }
    return item;
  };

  const figures = ({ done, total, note, seconds, seconds_left: left }) => [
    total ? `${done} of ${total}` : done || "", note, left === null ? `for ${duration(seconds)}` : `${duration(left)} left`,
  ].filter(Boolean).join(" · ");

  const show = ({ name, now, stopped, stages, preview, report }) => {
    document.title = `${now ? now.stage : "idle"} · ${name} · ClearGS`;
    one("name").textContent = name;
    one("label").textContent = now ? now.label : "No stage is running";
    one("progress").hidden = !now;
    if (now && now.total) one("progress").value = now.done / now.total;
    else one("progress").removeAttribute("value");
    one("figures").textContent = now
      ? figures(now)
      : stopped ? `${stopped}. Continue with cleargs run.`
      : "Continue with cleargs run, or write a report of these results with cleargs report.";
    one("preview").hidden = preview === null;
    if (preview !== null && one("picture").dataset.version !== preview) {
      one("picture").dataset.version = preview;
      one("picture").src = `/preview.png?${preview}`;
    }
    one("stages").replaceChildren(...stages.map(row));
    one("report").hidden = !report;
  };

  const update = async () => {
    try {
      const state = await (await fetch("/state.json")).json();
      if (state.done) {
        location.replace("/report/");
        return;
      }
      show(state);
    } catch {
      one("figures").textContent = "cleargs watch has stopped. Start it again to continue.";
    }
    setTimeout(update, EVERY_MS);
  };
  update();
}
