// What scripts/web_features.mjs has to find: each line that says so, and no other.
import { el } from "../../../web/common/text.js";

const { signal } = new AbortController();
AbortSignal.any([signal]); // newer
AbortSignal["any"]([signal]); // newer
const { withResolvers } = Promise; // newer
Promise.withResolvers(); // newer
Promise.try(() => 1); // newer
Array.fromAsync([]); // newer
Object.groupBy([1], String); // newer
Map.groupBy([1], String); // newer
[2, 1].toSorted(); // newer
[2, 1].with(0, 1); // newer
new Float64Array(2).toSorted(); // newer
export const sorted = (values) => values.toSorted(); // newer
new Map().values().map(String); // newer
new Set([1]).union(new Set()); // newer
"\ud800".isWellFormed(); // newer
crypto.randomUUID(); // newer
navigator.clipboard.writeText("x"); // newer
navigator.setAppBadge(1); // newer
requestIdleCallback(() => {}); // newer
URL.canParse("x"); // newer
new URLSearchParams("a=1").size; // newer
document.body.ariaLive = "polite"; // newer
document.body.showPopover(); // newer
document.body.popover = "auto"; // newer
document.querySelector("li:has(> a)"); // newer
document.body.closest(":has(a)"); // newer
document.body.checkVisibility(); // newer
document.startViewTransition(() => {}); // newer
addEventListener("scrollend", () => {}); // newer
el("div", { popover: "" }); // newer
document.body.setAttribute("popover", ""); // newer
document.body.style.setProperty("--x", "1");
document.body.style.textWrap = "balance"; // newer
export const letters = /\p{L}/v; // newer
export const price = /(?<=€)\d+/; // newer
export const loose = /(?i:a)b/; // newer
export class Block { static { Block.made = true; } } // newer
new Intl.DurationFormat("en"); // newer

[1].at(-1);
[1].findLast(Boolean);
structuredClone({});
Object.hasOwn({}, "x");
document.body.inert = true;
document.body.setAttribute("inert", "");
crypto.getRandomValues(new Uint8Array(2));
"a".replaceAll("a", "b");
addEventListener("pagehide", () => {}, { once: true, signal });
export const named = /(?<year>\d+)/u.exec("2026")?.groups.year ?? "";
