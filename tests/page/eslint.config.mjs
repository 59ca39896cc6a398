// Rules for the live page's JavaScript: what is undefined or unused, what is too long, and who may change what.
import js from "@eslint/js";
import globals from "globals";

const OWNERS = "/^(choices|panel|shown|site|times|view)$/";

export default [
  js.configs.recommended,
  {
    files: ["sitegrid/web/page/**/*.js"],
    languageOptions: { globals: globals.browser },
    linterOptions: { reportUnusedDisableDirectives: "error" },
    rules: {
      eqeqeq: "error",
      "max-len": ["error", { code: 120 }],
      "max-lines": ["error", 300],
      "max-lines-per-function": ["error", 40],
      "no-param-reassign": ["error", { props: true, ignorePropertyModificationsFor: ["context", "pen", "canvas"] }],
      "no-restricted-syntax": ["error", {
        selector: `AssignmentExpression > MemberExpression.left[object.name=${OWNERS}]`,
        message: "Only its own methods change an owner of state.",
      }],
      "no-var": "error",
      "prefer-const": "error",
    },
  },
];
