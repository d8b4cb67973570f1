// Says in plain words when this page does not work: a browser that is too old, scripts that did not come, and errors
// that nothing in the page handled. A plain script in the syntax of 2009: it has to run where the modules do not.
(function () {
  "use strict";

  var OLDEST = "Chrome, Edge or Android’s browser 109, Firefox 115, or Safari 16 (iOS 16)"; // scripts/browsers.json
  var SCRIPTS_LATE_MS = 30000;
  var MOST = 5; // errors that are written out
  var ENOUGH = 100;
  var box = null;
  var lines = null;
  var errors = [];
  var count = 0;
  var isStarted = false;

  /** Features that our oldest browsers have, and older ones mostly lack. */
  function isOld() {
    return !("noModule" in document.createElement("script")) || !Array.prototype.findLast || !window.CSS || !CSS.supports
      || !CSS.supports("height", "1dvh") || !CSS.supports("container-type", "inline-size");
  }

  function add(parent, tag, text) {
    var element = document.createElement(tag);
    element.textContent = text;
    parent.appendChild(element);
    return element;
  }

  function addButton(parent, text, press) {
    var button = add(parent, "button", text);
    button.type = "button";
    button.addEventListener("click", press);
  }

  /** In the flow of the page, above all else: it covers nothing. */
  function show(title, text) {
    if (!document.body) {
      document.addEventListener("DOMContentLoaded", function () { show(title, text); });
      return;
    }
    if (!box) {
      box = document.createElement("section");
      box.id = "guard";
      box.setAttribute("role", "alert");
      add(box, "h2", "");
      add(box, "p", "");
      lines = add(box, "pre", "");
      var row = add(box, "p", "");
      addButton(row, "Load this page again", function () { location.reload(); });
      addButton(row, "Dismiss", function () { box.hidden = true; });
      document.body.insertBefore(box, document.body.firstChild);
    }
    if (box.firstChild.textContent !== title) {
      box.firstChild.textContent = title;
      box.childNodes[1].textContent = text;
      box.hidden = false; // what was dismissed was something else
    }
    if (!errors.length) return;
    var more = count > errors.length ? "\n… and " + (count - errors.length) + " more" + (count < ENOUGH ? "" : " at least") : "";
    // Without query and fragment: these may hold a ticket.
    lines.textContent = errors.join("\n") + more + "\n" + location.origin + location.pathname + "\n" + navigator.userAgent;
  }

  function report(error) {
    if (count >= ENOUGH) return; // one that comes with each frame must not write for ever
    count += 1;
    if (errors.length < MOST && errors.indexOf(error) < 0) errors.push(error);
    if (isOld()) {
      showOld();
    } else if (isStarted) {
      show("This page met an error", "What it shows may be wrong or stand still from here on: load it again. The server, and what it records, are not touched. If it comes back, report these lines:");
    } else {
      show("This page could not start", "One of its scripts failed. Load it again. If it comes back, report these lines:");
    }
  }

  function showOld() {
    show("This browser is too old for this page", "Parts of the page do not work. It needs " + OLDEST + ", or a newer one: update this browser, or open this address in another one.");
  }

  window.addEventListener("error", function (event) {
    var target = event.target;
    if (target && (target.tagName === "SCRIPT" || target.rel === "stylesheet")) {
      report("A file of the page did not come: " + (target.src || target.href || "").split(/[?#]/)[0]);
      return;
    }
    if (!event.message || /^ResizeObserver loop/.test(event.message)) return; // the browser catches up by itself
    if (event.filename && event.filename.indexOf(location.origin + "/") !== 0) return; // of an extension
    var place = event.filename ? " (" + event.filename.split(/[?#]/)[0].slice(location.origin.length) + ":" + event.lineno + ":" + event.colno + ")" : "";
    report(event.message + place);
  }, true);

  window.addEventListener("unhandledrejection", function (event) {
    var reason = event.reason;
    if (reason && reason.name === "AbortError") return; // this page took its question back
    var stack = String(reason && reason.stack || "");
    if (/(?:-extension|extension):\/\//.test(stack)) return;
    var at = stack.split("\n").filter(function (line) { return line.indexOf(location.origin) >= 0; })[0] || "";
    report(String(reason) + (at ? " (" + at.replace(location.origin, "").replace(/^\s+/, "") + ")" : ""));
  });

  // A module's load event comes when it has run.
  document.addEventListener("load", function (event) {
    if (event.target.tagName !== "SCRIPT" || event.target.type !== "module") return;
    isStarted = true;
    if (box && !count && !isOld()) box.hidden = true; // late, and here
  }, true);

  document.addEventListener("DOMContentLoaded", function () {
    if (isOld()) {
      showOld();
      return;
    }
    setTimeout(function () {
      if (!isStarted) show("This page has not started yet", "Its scripts have not come within " + SCRIPTS_LATE_MS / 1000 + " s: the network is very slow, or the server is busy. It starts when they come.");
    }, SCRIPTS_LATE_MS);
  });
})();
