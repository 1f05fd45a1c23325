/* The door of a compiled module: tuples of arrays become structs, and all that could be read or
 * written beyond an array's end is checked. What is an index into something else is copied, so
 * that nobody can change it after it was checked; and reading a number runs no Python code, which
 * might move an array that was read before. */
#ifndef SLAM_OBSERVER_DOOR_H
#define SLAM_OBSERVER_DOOR_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stdint.h>
#include <string.h>

typedef int64_t i64;

enum { MAX_ARRAYS = 48, MAX_COPIES = 8, SIZES = 128, UNBOUND = -1 };

/* Views of all arrays of a call, copies of those that are indices, and the sizes that letters
 * stand for in shapes: what the first array with a letter has there, or what it was set to. */
typedef struct {
    Py_buffer views[MAX_ARRAYS];
    void *copies[MAX_COPIES];
    int count, copied;
    Py_ssize_t sizes[SIZES];
} Door;

typedef char members_have_8_bytes[sizeof(void *) == 8 && sizeof(double) == 8 ? 1 : -1];

static inline void open_door(Door *door) {
    door->count = door->copied = 0;
    for (int letter = 0; letter < SIZES; letter++)
        door->sizes[letter] = letter >= '0' && letter <= '9' ? letter - '0' : UNBOUND;
}

static inline void close_door(Door *door) {
    while (door->count)
        PyBuffer_Release(&door->views[--door->count]);
    while (door->copied)
        PyMem_Free(door->copies[--door->copied]);
}

static inline int refuse(const char *what) {
    PyErr_Format(PyExc_ValueError, "%s: a part has not the type or shape that belongs here", what);
    return 0;
}

/* The address of an array as ``spec`` describes it, a kind and its shape; NULL with an error. */
static inline void *read_array(Door *door, PyObject *array, const char *spec, const char *what) {
    static double nothing; /* of an array without entries there may be no address */
    int is_written = spec[0] == 'D' || spec[0] == 'L';
    char kind = spec[0] == 'D' ? 'd' : spec[0] == 'L' || spec[0] == 'x' ? 'l' : spec[0];
    int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (is_written ? PyBUF_WRITABLE : 0);
    Py_buffer *view = &door->views[door->count];
    if (door->count == MAX_ARRAYS || PyObject_GetBuffer(array, view, flags)) {
        if (!PyErr_Occurred())
            refuse(what);
        return NULL;
    }
    door->count++;
    const char *format = view->format == NULL ? "B" : view->format;
    int is_fit = (format[0] == kind || (kind == 'l' && format[0] == 'q')) && format[1] == '\0'
                 && view->itemsize == (kind == '?' ? 1 : 8) && view->ndim == (int)strlen(spec + 1);
    for (int d = 0; is_fit && d < view->ndim; d++) {
        Py_ssize_t *size = &door->sizes[(int)spec[1 + d]];
        *size = *size == UNBOUND ? view->shape[d] : *size;
        is_fit = view->shape[d] == *size;
    }
    void *address = !is_fit ? NULL : view->buf == NULL ? &nothing : view->buf;
    if (is_fit && spec[0] == 'x') { /* a copy lasts until the door is closed */
        void *copy = door->copied < MAX_COPIES ? PyMem_Malloc((size_t)view->len + 1) : NULL;
        if (copy != NULL)
            address = door->copies[door->copied++] = memcpy(copy, address, (size_t)view->len);
        else
            address = NULL;
    }
    if (address == NULL)
        refuse(what);
    return address;
}

/* Read a number of a kind as it lies in an object of Python's own types: no method is called. */
static inline int read_number(PyObject *item, char kind, char *member, const char *what) {
    if (kind == 'f' ? !PyFloat_Check(item) && !PyLong_Check(item) : !PyLong_Check(item))
        return refuse(what);
    if (kind == 'f') {
        double number = PyFloat_Check(item) ? PyFloat_AS_DOUBLE(item) : PyLong_AsDouble(item);
        memcpy(member, &number, 8);
    } else {
        i64 integer = PyLong_AsLongLong(item);
        integer = kind == 'b' ? integer != 0 : integer;
        memcpy(member, &integer, 8);
    }
    return !PyErr_Occurred();
}

/* Read a tuple into a struct whose first members are its fields, 8 bytes each: by their specs, an
 * int64 i, a number f, a truth b, or an array of float64 d, int64 l, indices x or bool ?, in
 * capitals where it is written to; after ~ it may be None, and is NULL then. */
static inline int read_fields(Door *door, PyObject *tuple, const char *const specs[], void *fields,
                       const char *what) {
    Py_ssize_t count = 0;
    while (specs[count])
        count++;
    if (!PyTuple_Check(tuple) || PyTuple_GET_SIZE(tuple) != count)
        return refuse(what);
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *item = PyTuple_GET_ITEM(tuple, i);
        const char *spec = specs[i] + (specs[i][0] == '~');
        char *member = (char *)fields + 8 * i;
        int is_none = spec != specs[i] && item == Py_None;
        if (spec[0] == 'f' || spec[0] == 'i' || spec[0] == 'b') {
            if (!read_number(item, spec[0], member, what))
                return 0;
            continue;
        }
        void *address = is_none ? NULL : read_array(door, item, spec, what);
        if (address == NULL && !is_none)
            return 0;
        memcpy(member, &address, 8);
    }
    return 1;
}

/* A module of ``methods`` that says which sources it was built from, as setup.py has it. */
#define MODULE(name, what) \
    static struct PyModuleDef definition = { \
        PyModuleDef_HEAD_INIT, .m_name = #name, .m_doc = what, .m_methods = methods, \
    }; \
    PyMODINIT_FUNC PyInit_##name(void) { \
        PyObject *module = PyModule_Create(&definition); \
        if (module != NULL && PyModule_AddIntConstant(module, "SOURCES", SOURCES)) \
            Py_CLEAR(module); \
        return module; \
    }
#define METHOD(name, function, what) \
    {name, (PyCFunction)(void (*)(void))function, METH_FASTCALL, what}

static inline int are_within(const i64 *numbers, Py_ssize_t count, i64 least, i64 most) {
    for (Py_ssize_t j = 0; j < count; j++)
        if (numbers[j] < least || numbers[j] > most)
            return 0;
    return 1;
}

#endif
