// In viewer.html as `pipeline view` serves it: the page of another training takes its place once that has a field.

const WATCH_MS = 3000; // less than OPEN_SECONDS of the server

async function watch(key = null) {
  let seen = key;
  try {
    const state = await (await fetch("state")).json(), runs = state.phase === "training" || state.phase === "finished";
    seen ??= state.key;
    if (runs && state.field && (state.phase === "training" || state.key !== seen)) return location.reload();
  } catch {
    // The server has ended; what is in the page stays.
  }
  setTimeout(() => watch(seen), WATCH_MS);
}
watch();
