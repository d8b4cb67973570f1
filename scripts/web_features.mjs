// Checks the pages' scripts, styles and HTML against the oldest browsers in browsers.json, with the data of MDN
// (@mdn/browser-compat-data): web APIs by their types where TypeScript infers them and by their names where it does
// not, syntax, options, attributes, events, selectors, properties, values, units and functions.
//
//   node web_features.mjs MODULES          checks web/, after a check of itself by tests/web/planted/
//   node web_features.mjs MODULES --write  writes tests/web/newer_features.json: what newer browsers have

import { readdirSync, readFileSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { dirname, join, relative } from "node:path";
import { fileURLToPath } from "node:url";

const ROOT = dirname(dirname(fileURLToPath(import.meta.url)));
const TABLE = join(ROOT, "tests/web/newer_features.json");
const [modules, mode] = process.argv.slice(2);
const required = createRequire(join(modules, "node_modules/")); // whatever is beside this script
const bcd = required("@mdn/browser-compat-data");
const ts = required("compiler"); // TypeScript 6, the last one with a stable API
const cssTree = required("css-tree");
const parse5 = required("parse5");
const acorn = required("acorn");
const { oldest, allowed } = JSON.parse(readFileSync(join(ROOT, "scripts/browsers.json"), "utf8"));

// --- which browsers lack a feature ------------------------------------------------------------------------------

const numbers = (version) => version.replace("≤", "").split(".").map(Number);
function isAtMost(a, b) {
  const [x, y] = [numbers(a), numbers(b)];
  const i = [0, 1, 2].find((at) => (x[at] ?? 0) !== (y[at] ?? 0)) ?? 0;
  return (x[i] ?? 0) <= (y[i] ?? 0);
}

function isSupported(support, version) {
  return [support ?? []].flat().some((one) => typeof one.version_added === "string" && one.version_added !== "preview"
    && !one.flags && !one.prefix && !one.alternative_name && isAtMost(one.version_added, version)
    && !(typeof one.version_removed === "string" && isAtMost(one.version_removed, version)
      && one.version_last === undefined));
}

/** Our oldest browsers that lack a feature: "firefox 121". */
function lackedBy(feature) {
  const support = feature?.__compat?.support;
  if (!support) return [];
  return Object.entries(oldest).filter(([browser, version]) => support[browser] !== undefined && !isSupported(support[browser], version))
    .map(([browser]) => `${browser} ${[support[browser]].flat().find((one) => !one.flags && !one.prefix)?.version_added || "(none)"}`);
}

const isNow = (feature) => [feature.__compat.support.chrome].flat().some((one) => typeof one?.version_added === "string" && one.version_added !== "preview" && !one.flags && !one.version_removed);

// --- features by name --------------------------------------------------------------------------------------------

const { builtins, classes, operators, regular_expressions: regexps, statements } = bcd.javascript;
const owner = (name) => (Object.hasOwn(builtins, name) ? builtins[name] : Object.hasOwn(bcd.api, name) ? bcd.api[name] : undefined);
const own = (object, name) => (object && Object.hasOwn(object, name) ? object[name] : undefined);

/** Members of instances, by their names, of all interfaces: for values whose type is not known. */
const members = new Map();
for (const all of [builtins, bcd.api]) {
  for (const [of, features] of Object.entries(all)) {
    for (const [name, feature] of Object.entries(features)) {
      if (name === "__compat" || name.endsWith("_static") || !feature.__compat) continue;
      if (!members.has(name)) members.set(name, []);
      members.get(name).push([`${of}.${name}`, feature]);
    }
  }
}

const problems = [];
/** By its name, or of a property, an attribute and their values by the name of that. */
const isAllowed = (name) => Object.hasOwn(allowed, name) || Object.hasOwn(allowed, name.split(/[:=]/)[0]);
function report(place, name, feature) {
  const lacking = lackedBy(feature);
  if (lacking.length && !isAllowed(name)) problems.push({ ...place, name, text: `${name} needs ${lacking.join(", ")}` });
}

/** Only if it is too new wherever it is: `at` of an unknown value may be an array's. */
function reportByName(place, name) {
  const found = members.get(name) ?? [];
  if (found.length && found.every(([, feature]) => lackedBy(feature).length)) report(place, ...found[0]);
}

// --- JavaScript --------------------------------------------------------------------------------------------------

const files = (folder, end) => readdirSync(folder, { recursive: true }).filter((name) => name.endsWith(end)).map((name) => join(folder, name));
const isOfLib = (file) => /[\\/]lib\.[^\\/]*\.d\.ts$/.test(file.fileName);
const isSecureOnly = (symbol) => symbol.getDocumentationComment(undefined).some(({ text }) => text.includes("Available only in secure contexts"));

function checkScripts(paths) {
  const types = join(ROOT, "scripts/page_types.d.ts");
  const program = ts.createProgram([...paths, types], {
    allowJs: true, checkJs: true, noEmit: true, strict: true, noImplicitAny: false, strictNullChecks: false, types: [],
    target: ts.ScriptTarget.ESNext, module: ts.ModuleKind.ESNext, moduleResolution: ts.ModuleResolutionKind.Bundler,
    lib: ["lib.esnext.d.ts", "lib.dom.d.ts"],
  });
  const checker = program.getTypeChecker();
  const sources = program.getSourceFiles().filter((file) => paths.includes(file.fileName));

  const ours = new Set(); // names of properties that are declared here
  const collect = (node) => {
    if ((ts.isPropertyAssignment(node) || ts.isShorthandPropertyAssignment(node) || ts.isMethodDeclaration(node) || ts.isPropertySignature(node)
      || ts.isPropertyDeclaration(node) || ts.isGetAccessorDeclaration(node)) && node.name && ts.isIdentifier(node.name)) ours.add(node.name.text);
    if (ts.isBinaryExpression(node) && ts.isPropertyAccessExpression(node.left) && node.left.expression.kind === ts.SyntaxKind.ThisKeyword) ours.add(node.left.name.text);
    node.jsDoc?.forEach(collect);
    ts.forEachChild(node, collect);
  };
  for (const file of [...sources, program.getSourceFile(types)]) collect(file);

  for (const file of sources) {
    const placeOf = (node) => ({ file: file.fileName, line: file.getLineAndCharacterOfPosition(node.getStart(file)).line + 1 });

    /** What a declaration of TypeScript's libraries is in MDN's data. */
    const featureOf = (declaration, name) => {
      const at = declaration.parent;
      if (ts.isInterfaceDeclaration(at)) {
        const type = at.name.text;
        if (/^CSSStyle(?:Declaration|Properties)$/.test(type)) {
          const property = name.replace(/[A-Z]/g, (letter) => `-${letter.toLowerCase()}`);
          if (own(bcd.css.properties, property)) return [property, bcd.css.properties[property]];
        }
        const constructed = type.endsWith("Constructor") ? own(builtins, type.slice(0, -11)) : undefined;
        if (constructed) return [`${type.slice(0, -11)}.${name}`, own(constructed, name) ?? own(constructed, `${name}_static`)];
        const real = { ReadonlyArray: "Array", ReadonlyMap: "Map", ReadonlySet: "Set", ReadonlySetLike: "Set", IteratorObject: "Iterator", CallableFunction: "Function", NewableFunction: "Function" }[type] ?? type;
        return [`${real}.${name}`, own(owner(real), name) ?? own(own(builtins, `${real.replace(/(?:Uint|Int|Float|BigInt|BigUint)(?:8|16|32|64)(?:Clamped)?Array/, "TypedArray")}`), name)];
      }
      if (ts.isTypeLiteralNode(at) && ts.isVariableDeclaration(at.parent)) { // declare var AbortSignal: { any(...): ... }
        const type = at.parent.name.text;
        return [`${type}.${name}`, own(owner(type), `${name}_static`) ?? own(owner(type), name)];
      }
      return globalOf(name);
    };
    const globalOf = (name) => [name, own(owner(name), "__compat") ? owner(name) : own(bcd.api.Window, name)];

    const checkName = (node, name, symbol) => {
      const declared = (symbol?.declarations ?? []).filter((one) => isOfLib(one.getSourceFile()));
      if (symbol?.declarations?.length && !declared.length) return; // ours
      if (declared.length && declared.every(ts.isIndexSignatureDeclaration)) return; // of a dataset
      if (!declared.length) {
        const of = ts.isPropertyAccessExpression(node.parent) && checker.getTypeAtLocation(node.parent.expression);
        if (of && checker.getIndexInfosOfType(of).length) return; // a table of ours
        if (!ours.has(name)) reportByName(placeOf(node), name);
        return;
      }
      if (isSecureOnly(symbol) && !Object.hasOwn(allowed, name)) problems.push({ ...placeOf(node), name, text: `${name} exists in secure contexts only, not on http:// in a network` });
      const found = declared.map((one) => featureOf(one, name)).filter(([, feature]) => feature);
      if (!found.length) reportByName(placeOf(node), name);
      else if (found.every(([, feature]) => lackedBy(feature).length)) report(placeOf(node), ...found[0]);
    };

    const checkPattern = (node, pattern, flags) => {
      const place = placeOf(node);
      if (flags.includes("v")) report(place, "RegExp v flag", builtins.RegExp.unicodeSets);
      if (flags.includes("d")) report(place, "RegExp d flag", builtins.RegExp.hasIndices);
      if (/\(\?<[=!]/.test(pattern)) report(place, "lookbehind", regexps.lookbehind_assertion);
      if (/\(\?[ims]*-?[ims]+:/.test(pattern)) report(place, "RegExp modifiers", regexps.modifier);
      const names = [...pattern.matchAll(/\(\?<(\w+)>/g)].map(([, name]) => name);
      if (new Set(names).size < names.length) report(place, "duplicate named groups", regexps.named_capturing_group.duplicate_named_capturing_groups);
    };

    const checkSyntax = (node) => {
      const say = (name, feature) => report(placeOf(node), name, feature);
      if (ts.isRegularExpressionLiteral(node)) checkPattern(node, ...node.text.match(/^\/(.*)\/([a-z]*)$/s).slice(1));
      else if (ts.isClassStaticBlockDeclaration(node)) say("static block", classes.static.initialization_blocks);
      else if (ts.isPropertyDeclaration(node)) say("class field", ts.isPrivateIdentifier(node.name) ? classes.private_class_fields : classes.public_class_fields);
      else if (ts.isMethodDeclaration(node) && ts.isPrivateIdentifier(node.name)) say("private method", classes.private_class_methods);
      else if (ts.isBinaryExpression(node) && ts.isPrivateIdentifier(node.left)) say("private name in", classes.private_class_fields_in);
      else if (ts.isAwaitExpression(node) && !ts.findAncestor(node, ts.isFunctionLike)) say("await at the top of a module", operators.await.top_level);
      else if (ts.isImportAttributes?.(node)) say("import attributes", statements.import.import_attributes);
      else if (ts.isVariableDeclarationList(node) && (node.flags & ts.NodeFlags.Using) === ts.NodeFlags.Using) say("using", statements.using);
      else if (ts.isBinaryExpression(node)) {
        const operator = { "??=": "nullish_coalescing_assignment", "||=": "logical_or_assignment", "&&=": "logical_and_assignment", "??": "nullish_coalescing" }[node.operatorToken.getText(file)];
        if (operator) say(operator, operators[operator]);
      }
    };

    const textOf = (node) => (node && ts.isStringLiteralLike(node) ? node.text : undefined);

    /** Strings and options that name features. */
    const checkCall = (node) => {
      const callee = ts.isPropertyAccessExpression(node.expression) ? node.expression.name.text : node.expression.getText(file);
      const first = textOf(node.arguments?.[0]);
      if (first !== undefined) {
        if (/^(?:querySelector(?:All)?|closest|matches)$/.test(callee)) checkStyle(first, placeOf(node), "selectorList");
        if (callee === "isInside" && textOf(node.arguments[1])) checkStyle(node.arguments[1].text, placeOf(node), "selectorList");
        if (callee === "matchMedia") checkStyle(`@media ${first} {}`, placeOf(node), "stylesheet");
        if (callee === "addEventListener") reportByName(placeOf(node), `${first}_event`);
        if (/^(?:set|toggle|remove|has|get)Attribute$/.test(callee)) checkAttribute(placeOf(node), "", first);
        if (callee === "el" || callee === "createElement") checkElement(placeOf(node), first);
        if (callee === "RegExp") checkPattern(node, first, textOf(node.arguments[1]) ?? "");
      }
      for (const given of node.arguments ?? []) {
        if (!ts.isObjectLiteralExpression(given)) continue;
        const keys = given.properties.map((property) => property.name && (ts.isIdentifier(property.name) || ts.isStringLiteral(property.name)) ? property.name.text : "").filter(Boolean);
        if (callee === "el") for (const key of keys) checkAttribute(placeOf(given), first ?? "", key);
        const symbol = checker.getSymbolAtLocation(ts.isPropertyAccessExpression(node.expression) ? node.expression.name : node.expression);
        const name = symbol?.name ?? callee;
        const features = (symbol?.declarations ?? []).filter((one) => isOfLib(one.getSourceFile())).map((one) => featureOf(one, name)[1]).filter(Boolean);
        const options = features.length ? features : (members.get(callee) ?? []).map(([, feature]) => feature);
        for (const key of keys) {
          const found = options.flatMap((feature) => [feature, feature[callee]]).filter(Boolean).map((feature) => own(feature, `options_${key}_parameter`) ?? own(feature, `${key}_parameter`) ?? own(own(feature, "options_parameter"), key) ?? own(own(feature, "options_parameter"), `options_${key}_parameter`)).filter(Boolean);
          if (found.length && found.every((feature) => lackedBy(feature).length)) report(placeOf(given), `${callee}({ ${key} })`, found[0]);
        }
      }
    };

    const visit = (node) => {
      if (ts.isJSDoc(node)) return;
      checkSyntax(node);
      if (ts.isPropertyAccessExpression(node)) checkName(node.name, node.name.text, checker.getSymbolAtLocation(node.name));
      else if (ts.isElementAccessExpression(node) && textOf(node.argumentExpression)) checkName(node, textOf(node.argumentExpression), checker.getSymbolAtLocation(node.argumentExpression));
      else if (ts.isBindingElement(node) && ts.isObjectBindingPattern(node.parent)) {
        const name = node.propertyName ?? node.name;
        if (ts.isIdentifier(name)) checkName(name, name.text, checker.getTypeAtLocation(node.parent).getProperty(name.text));
      } else if (ts.isIdentifier(node) && !ts.isPropertyAccessExpression(node.parent) || ts.isIdentifier(node) && ts.isPropertyAccessExpression(node.parent) && node.parent.expression === node) {
        const symbol = checker.getSymbolAtLocation(node);
        const isGlobal = !symbol?.declarations?.length || symbol.declarations.every((one) => isOfLib(one.getSourceFile()));
        const [name, feature] = globalOf(node.text);
        const isUse = !ts.isPropertyAssignment(node.parent) || node.parent.initializer === node;
        if (isGlobal && isUse && feature && !(ts.isBindingElement(node.parent) && node.parent.propertyName === node)) {
          if (symbol && isSecureOnly(symbol) && !Object.hasOwn(allowed, name)) problems.push({ ...placeOf(node), name, text: `${name} exists in secure contexts only, not on http:// in a network` });
          report(placeOf(node), name, feature);
        }
      }
      if (ts.isCallExpression(node) || ts.isNewExpression(node)) checkCall(node);
      ts.forEachChild(node, visit);
    };
    visit(file);
  }
}

/** A script without type="module" has to be read by the oldest of all: it says that they are too old. */
function checkPlainScript(path) {
  try {
    acorn.parse(readFileSync(path, "utf8"), { ecmaVersion: 5 });
  } catch (error) {
    problems.push({ file: path, line: error.loc?.line ?? 1, name: "plain script", text: `a script that is no module has the syntax of ECMAScript 5: ${error.message}` });
  }
}

// --- CSS ---------------------------------------------------------------------------------------------------------

const functions = new Map();
(function collect(features) {
  for (const [name, feature] of Object.entries(features)) {
    if (name === "__compat") continue;
    if (!functions.has(name)) functions.set(name, feature);
    if (["color", "image", "gradient", "filter-function", "transform-function", "basic-shape", "easing-function"].includes(name)) collect(feature);
  }
})(bcd.css.types);

const UNITS = [[/^dv/, "viewport_percentage_units_dynamic"], [/^lv/, "viewport_percentage_units_large"], [/^sv/, "viewport_percentage_units_small"], [/^cq/, "container_query_length_units"]];

function checkStyle(text, start, context, allowsSupports = true) {
  const tree = cssTree.parse(text, { positions: true, context, parseValue: true, onParseError: (error) => problems.push({ ...start, name: "CSS", text: `CSS that is not understood: ${error.message}` }) });
  const ats = [];
  const rules = [];
  cssTree.walk(tree, {
    enter(node) {
      const place = { file: start.file, line: start.line + (node.loc ? node.loc.start.line - 1 : 0) };
      if (node.type === "Atrule") ats.push(node);
      // What asks first, by @supports, may use what it asks for.
      if (allowsSupports && ats.some((at) => at.name === "supports")) return;
      if (node.type === "Rule") {
        if (rules.length) report(place, "nesting", bcd.css.selectors.nesting);
        rules.push(node);
      } else if (node.type === "Atrule") report(place, `@${node.name}`, own(bcd.css["at-rules"], node.name));
      else if (node.type === "NestingSelector") report(place, "nesting", bcd.css.selectors.nesting);
      else if (node.type === "PseudoClassSelector" || node.type === "PseudoElementSelector") report(place, `:${node.name}`, own(bcd.css.selectors, node.name));
      else if (node.type === "Nth" && node.selector) report(place, ":nth-child(of)", bcd.css.selectors["nth-child"].of_syntax);
      else if (node.type === "Feature") report(place, `(${node.name})`, own(bcd.css["at-rules"].media, node.name));
      else if (node.type === "FeatureRange") report(place, "media range", bcd.css["at-rules"].media.range_syntax);
      else if (node.type === "Dimension") {
        const unit = node.unit.toLowerCase();
        report(place, `unit ${unit}`, bcd.css.types.length[UNITS.find(([of]) => of.test(unit))?.[1] ?? unit]);
      } else if (node.type === "Function") report(place, `${node.name}()`, functions.get(node.name));
      else if (node.type === "Declaration" && !node.property.startsWith("--")) {
        const property = own(bcd.css.properties, node.property);
        report(place, node.property, property);
        if (node.value.type === "Value") node.value.children.forEach((one) => { if (one.type === "Identifier") report(place, `${node.property}: ${one.name}`, own(property, one.name)); });
      }
    },
    leave(node) {
      if (node.type === "Atrule") ats.pop();
      if (node.type === "Rule" && rules.at(-1) === node) rules.pop();
    },
  });
}

// --- HTML --------------------------------------------------------------------------------------------------------

function checkElement(place, tag) {
  report(place, `<${tag}>`, own(bcd.html.elements, tag));
}

function checkAttribute(place, tag, name, value = "") {
  const feature = own(own(bcd.html.elements, tag), name) ?? own(bcd.html.global_attributes, name)
    ?? (tag ? undefined : Object.values(bcd.html.elements).map((element) => own(element, name)).find(Boolean));
  report(place, name, feature);
  if (value) report(place, `${name}="${value}"`, own(feature, value) ?? own(own(bcd.html.elements, tag), `${name}_${value}`));
}

function checkHtml(path) {
  const visit = (node) => {
    const place = { file: path, line: node.sourceCodeLocation?.startLine ?? 1 };
    if (node.tagName) {
      checkElement(place, node.tagName);
      for (const { name, value } of node.attrs) {
        checkAttribute(place, node.tagName, name, value);
        if (name === "style") checkStyle(value, place, "declarationList");
      }
      const source = node.tagName === "script" && node.attrs.find(({ name }) => name === "src")?.value;
      if (source && source.startsWith("/static/") && !node.attrs.some(({ name }) => name === "type")) checkPlainScript(join(ROOT, "web", source.slice(8)));
    }
    (node.childNodes ?? []).forEach(visit);
    if (node.content) visit(node.content);
  };
  visit(parse5.parse(readFileSync(path, "utf8"), { sourceCodeLocationInfo: true }));
}

function check(folder) {
  problems.length = 0;
  checkScripts(files(folder, ".js"));
  for (const path of files(folder, ".css")) checkStyle(readFileSync(path, "utf8"), { file: path, line: 1 }, "stylesheet");
  for (const path of files(folder, ".html")) checkHtml(path);
  return [...new Map(problems.map((one) => [`${one.file}:${one.line} ${one.text}`, one])).entries()];
}

// --- the table, and the check of this check ----------------------------------------------------------------------

/** Interfaces (null: as a whole) and their members that the newest Chrome has and one of our oldest browsers lacks. */
function newerFeatures() {
  const table = {};
  for (const all of [bcd.api, builtins]) {
    for (const [of, features] of Object.entries(all)) {
      if (of === "__compat" || !/^\w+$/.test(of)) continue;
      if (features.__compat && lackedBy(features).length) {
        if (isNow(features)) table[of] = null;
        continue;
      }
      const names = Object.keys(features).filter((name) => /^\w+$/.test(name) && name !== "__compat" && name !== of && !name.endsWith("_event")
        && features[name].__compat && lackedBy(features[name]).length && isNow(features[name]));
      if (names.length) table[of] = names;
    }
  }
  return `{\n${Object.entries(table).map(([of, names]) => `${JSON.stringify(of)}: ${JSON.stringify(names)}`).join(",\n")}\n}\n`;
}

/** Each line that says "newer" in a comment has to be found, and no other. */
function checkPlanted() {
  const folder = join(ROOT, "tests/web/planted");
  const found = new Set(check(folder).map(([, { file, line }]) => `${relative(folder, file)}:${line}`));
  const wanted = readdirSync(folder).flatMap((name) => readFileSync(join(folder, name), "utf8").split("\n")
    .flatMap((line, i) => (/(?:\/\/|\/\*|<!--) newer/.test(line) ? [`${name}:${i + 1}`] : [])));
  const wrong = [...wanted.filter((place) => !found.has(place)).map((place) => `not found: ${place}`),
    ...[...found].filter((place) => !wanted.includes(place)).map((place) => `found, and old: ${place}`)];
  if (!wanted.length || wrong.length) throw new Error(`the check of web features is wrong about tests/web/planted:\n${wrong.join("\n")}`);
}

const table = newerFeatures();
if (mode === "--write") {
  writeFileSync(TABLE, table);
} else {
  checkPlanted();
  const found = check(join(ROOT, "web")).map(([, { file, line, text }]) => `${relative(ROOT, file)}:${line}: ${text}`);
  if (readFileSync(TABLE, "utf8") !== table) found.push("tests/web/newer_features.json is not of these data: sh scripts/pages --write");
  for (const one of found) console.error(one);
  process.exitCode = found.length ? 1 : 0;
}
