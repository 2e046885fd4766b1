"""Stands for a loop whose compilation prints."""


class _Prints:
    def compile(self, signature: object) -> None:
        print("compiling", signature, flush=True)


prints = _Prints()
