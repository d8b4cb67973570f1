// Service worker: if the server cannot be reached, a page that says so. It stores that page only, never another page,
// script or data: what the browser shows comes from the server, now.

const CACHE = "foottile-offline-1";
const PAGE = "/static/offline.html";
const FILES = [PAGE, "/static/offline.css", "/static/favicon.svg"];
const worker = /** @type {any} */ (self); // TypeScript knows it as a window

worker.addEventListener("install", (event) => {
  worker.skipWaiting();
  event.waitUntil(caches.open(CACHE).then((cache) => cache.addAll(FILES)));
});

worker.addEventListener("activate", (event) => {
  const removeOld = async () => {
    for (const name of await caches.keys()) if (name !== CACHE) await caches.delete(name);
    await worker.clients.claim();
  };
  event.waitUntil(removeOld());
});

worker.addEventListener("fetch", (event) => {
  const { pathname } = new URL(event.request.url);
  const isPage = event.request.mode === "navigate" && !pathname.startsWith("/api/"); // downloads are navigations, too
  if (!isPage && !FILES.includes(pathname)) return;
  event.respondWith(fetch(event.request).catch(() => caches.match(isPage ? PAGE : pathname)));
});
